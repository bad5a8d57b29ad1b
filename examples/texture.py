"""Recover the texture of a floor from one image of a room, with an error for every texel.

    python examples/texture.py

Writes texture.png: the true texels, the fitted ones, and their standard errors, white at 0.1. Texels that no pixel
sees, such as those behind the box, are red.
"""

import argparse

import numpy as np
from scipy import ndimage

import pathjax as pj
from pathjax import Transform
from pathjax.images import write_png
from pathjax.images.picture import side_by_side
from pathjax.inverse import report

NAME = "carpet.reflectance"


def pattern(size: int) -> np.ndarray:
    """Return a (size, size, 3) texture of smooth colours with a disk and a square."""
    noise = np.random.default_rng(0).normal(size=(size, size, 3))
    smooth = ndimage.gaussian_filter(noise, (size / 12, size / 12, 0), mode="wrap")
    texels = 0.45 + 0.12 * smooth / smooth.std()
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    texels[(x - 0.65) ** 2 + (y - 0.7) ** 2 < 0.02] = [0.7, 0.25, 0.15]
    texels[(abs(x - 0.25) < 0.12) & (abs(y - 0.6) < 0.12)] = [0.2, 0.3, 0.6]
    return np.clip(texels, 0.02, 0.98).astype(np.float32)


def room(size: int, res: int) -> pj.Scene:
    """Build a scene of a carpet, a box on it and a wall behind, under a lamp."""
    wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.6, 0.6]}}
    flat, turn = Transform(), Transform().rotate([1, 0, 0], -90)
    texels = {"type": "bitmap", "data": pattern(size), "raw": True, "wrap_mode": "clamp"}
    camera = Transform().look_at(origin=[0, 2.2, 3], target=[0, 0, 0.1], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": res, "height": res, "rfilter": {"type": "box"}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [9, 8, 6]}}
    above = flat.translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(0.7)
    return pj.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 6},
            "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
            "carpet": {"type": "diffuse", "reflectance": texels},
            "floor": {"type": "rectangle", "to_world": turn, "bsdf": {"type": "ref", "id": "carpet"}},
            "back": {"type": "rectangle", "to_world": flat.translate([0, 1, -1]), "bsdf": wall},
            "box": {"type": "cube", "to_world": flat.translate([0.3, 0.3, -0.3]).scale(0.3), "bsdf": wall},
            "lamp": {"type": "rectangle", "to_world": above, "emitter": lamp},
        }
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=64, help="of the texture")
    parser.add_argument("--res", type=int, default=192)
    parser.add_argument("--target-spp", type=int, default=1024)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("-o", "--output", default="texture.png")
    options = parser.parse_args()

    scene = room(options.size, options.res)
    truth = np.asarray(pj.parameters(scene)[NAME])
    target = np.asarray(pj.render(scene, options.target_spp, seed=1))
    start = {NAME: np.full(truth.shape, 0.5)}
    fit = pj.fit(scene, target, [NAME], start=start, spp=options.spp, smoothness="auto", progress=True)
    print(report.text(fit))

    seen, errors = fit.seen[NAME], fit.values[NAME] - truth
    stated = fit.standard_errors[NAME]
    rms, in_stated = np.sqrt(np.mean(errors[seen] ** 2)), np.sqrt(np.mean((errors[seen] / stated[seen]) ** 2))
    print(f"of texels that are seen, RMS error {rms:.1e}; in stated standard errors {in_stated:.2f}")
    shown = np.where(seen[..., None], np.minimum(stated / 0.1, 1), [0.6, 0, 0])
    write_png(options.output, side_by_side([truth, fit.values[NAME], shown]))


if __name__ == "__main__":
    main()
