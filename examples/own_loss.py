"""Minimise a loss of your own around `render` with optimistix.BFGS: give the Cornell box a mood by its walls.

    python examples/own_loss.py

The image should have a given mean colour, and its left and right halves should be equally bright. Gradients through the
renderer find the albedos that achieve this. Writes own_loss.png: before and after.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import pathjax as pj
from pathjax.images import write_png

NAMES = ["white.reflectance", "red.reflectance", "green.reflectance"]
MEAN_COLOR = jnp.array([0.16, 0.12, 0.09])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=96)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("-o", "--output", default="own_loss.png")
    options = parser.parse_args()
    scene = pj.load_scene(Path(__file__).parents[1] / "scenes" / "cornell_box.xml", res=options.res)

    def decorated(x):
        albedos = jax.nn.sigmoid(x).reshape(len(NAMES), 3)
        return pj.with_parameters(scene, dict(zip(NAMES, albedos, strict=True)))

    def loss(x, _):
        # The same seed for all x makes the loss a smooth function of x.
        image = pj.render(decorated(x), options.spp, seed=7)
        # Clip, as the visible lamp would dominate the means.
        image = jnp.minimum(image, 1)
        left, right = image[:, : options.res // 2], image[:, options.res // 2 :]
        color = jnp.sum((image.mean((0, 1)) - MEAN_COLOR) ** 2)
        balance = jnp.sum((left.mean((0, 1)) - right.mean((0, 1))) ** 2)
        return 100 * (color + balance)

    start = jnp.concatenate([jax.scipy.special.logit(pj.parameters(scene)[name]) for name in NAMES])
    solution = optx.minimise(loss, optx.BFGS(rtol=1e-3, atol=1e-4), start, max_steps=options.steps, throw=False)
    before, after, steps = loss(start, None), loss(solution.value, None), int(solution.stats["num_steps"])
    print(f"loss {before:.3g} -> {after:.3g} in {steps} steps")
    for name in NAMES:
        print(f"{name:<18}  {np.array2string(np.asarray(pj.parameters(decorated(solution.value))[name]), precision=3)}")
    images = [np.asarray(pj.render(decorated(x), 8 * options.spp)) for x in (start, solution.value)]
    write_png(options.output, np.concatenate(images, 1))


if __name__ == "__main__":
    main()
