"""Recover the index of refraction of a glass ball in front of stripes, from a start in the wrong valley.

    python examples/glass_ior.py

From 1.2, a local method ends where the stripes happen to line up again. `fit` scans the range first; without the scan,
it reports that it has not converged. Writes glass_ior.png: the fit with the scan above, the one without below.
"""

import argparse
from pathlib import Path

import numpy as np

import pathjax as pj
from pathjax.images import write_png
from pathjax.inverse import report


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=96)
    parser.add_argument("--target-spp", type=int, default=1024)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("-o", "--output", default="glass_ior.png")
    options = parser.parse_args()

    scene = pj.load_scene(Path(__file__).parents[1] / "scenes" / "glass_ball.xml", res=options.res)
    target = np.asarray(pj.render(scene, options.target_spp, seed=1))
    pictures = []
    for scan in (True, False):
        print(f"\nfrom 1.2, {'with' if scan else 'without'} a scan:")
        fit = pj.fit(scene, target, ["glass.int_ior"], start={"glass.int_ior": 1.2}, spp=options.spp, scan=scan)
        print(report.text(fit))
        pictures.append(report.picture(fit, [target]))
    write_png(options.output, np.concatenate(pictures))


if __name__ == "__main__":
    main()
