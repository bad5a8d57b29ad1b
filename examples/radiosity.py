"""Render the Cornell box without its boxes by linear algebra, (I - T)^-1 Le on patches, and by path tracing.

    python examples/radiosity.py

Prints how the error falls as the patches get smaller, and how GMRES and the Neumann series converge. Writes
radiosity.png: three meshes, the path tracer, and its difference from the finest mesh (red: too bright).
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import pathjax as pj
from pathjax import scene, transport
from pathjax.images import picture, write_png
from pathjax.shapes import Cube

BLOCKS = 32  # across the image; means over blocks hide pixel noise and patch edges


def empty_box(res):
    box = pj.load_scene(Path(__file__).parents[1] / "scenes" / "cornell_box.xml", res=res, max_depth=-1)
    full = box.about.description
    walls = tuple(shape for shape in full.shapes if not isinstance(shape.geometry, Cube))
    return scene.build(replace(full, shapes=walls))


def block_means(image):
    size = image.shape[0] // BLOCKS
    return image.reshape(BLOCKS, size, BLOCKS, size, 3).mean((1, 3))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=256, help=f"a multiple of {BLOCKS}")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--patches", type=int, nargs="+", default=[100, 400, 1600])
    parser.add_argument("-o", "--output", default="radiosity.png")
    options = parser.parse_args()

    box = empty_box(options.res)
    traced = [np.asarray(pj.render(box, options.spp, seed)) for seed in (1, 2)]
    reference = block_means(np.mean(traced, 0))
    scale = np.sqrt(np.mean(reference**2))

    images = []
    print("patches   seconds   residual   error of 32 x 32 block means")
    for count in options.patches:
        start = time.perf_counter()
        op = transport.operator(box, count)
        solution = op.solve()
        seconds = time.perf_counter() - start
        # With the camera rays of the renders, so that the error of pixel sampling cancels.
        light = op.radiosity(solution.L)
        images.append(np.mean([transport.image(box, light, options.spp, seed) for seed in (1, 2)], 0))
        error = np.sqrt(np.mean((block_means(images[-1]) - reference) ** 2)) / scale
        print(f"{op.patches.count:7} {seconds:9.1f} {float(solution.residual):10.1e}   {error:.2%}")
    first, second = (
        block_means(np.asarray(transport.image(box, light, options.spp, seed)) - image)
        for seed, image in zip((1, 2), traced, strict=True)
    )
    noise = np.sqrt(np.mean((first - second) ** 2) / 4) / scale
    print(f"of which noise of the path tracer {noise:.2%}; the rest is the mesh")

    print(f"\nspectral radius {np.array2string(np.asarray(op.spectral_radius()), precision=3)}")
    print("bounces   residual of GMRES   of the Neumann series")
    histories = [op.residual_history(12, method) for method in ("gmres", "neumann")]
    for bounces in range(0, 13, 3):
        print(f"{bounces:7} {histories[0][bounces]:19.1e} {histories[1][bounces]:23.1e}")

    left = block_means(images[-1]) - reference
    signed = picture.signed_colors(left.mean(-1) / (0.02 * reference.mean(-1) + 0.01 * scale))
    zoom = options.res // BLOCKS
    write_png(
        options.output,
        picture.side_by_side([*images, np.mean(traced, 0), np.repeat(np.repeat(signed, zoom, 0), zoom, 1)]),
    )


if __name__ == "__main__":
    main()
