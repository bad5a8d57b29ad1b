"""Recover the three albedos of the Cornell box from one image, starting from grey.

    python examples/cornell_albedos.py

Writes cornell_albedos.png: target, fit, and residual in standard deviations.
"""

import argparse
from pathlib import Path

import numpy as np

import pathjax as pj
from pathjax.images import write_png
from pathjax.inverse import report

NAMES = ["white.reflectance", "red.reflectance", "green.reflectance"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=64)
    parser.add_argument("--target-spp", type=int, default=4096)
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("-o", "--output", default="cornell_albedos.png")
    options = parser.parse_args()

    scene = pj.load_scene(Path(__file__).parents[1] / "scenes" / "cornell_box.xml", res=options.res)
    truth = pj.parameters(scene)
    # With another seed than the fit uses; a photograph would do as well.
    target = np.asarray(pj.render(scene, options.target_spp, seed=1))

    start = {name: 0.4 for name in NAMES}
    fit = pj.fit(scene, target, NAMES, start=start, spp=options.spp)
    print(report.text(fit))

    errors = np.concatenate([fit.values[name] - truth[name] for name in NAMES])
    stated = np.concatenate([fit.standard_errors[name] for name in NAMES])
    rms, in_stated = np.sqrt(np.mean(errors**2)), np.sqrt(np.mean((errors / stated) ** 2))
    print(f"RMS error {rms:.1e}; in stated standard errors {in_stated:.2f}")
    write_png(options.output, report.picture(fit, [target]))


if __name__ == "__main__":
    main()
