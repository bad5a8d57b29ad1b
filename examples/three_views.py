"""Recover the IOR of a glass ball and the two colours behind it together, from three views.

    python examples/three_views.py

Views are scenes that share parameters by name. Writes three_views.png: target, fit and residual of each view and, below
them, the correlations of the recovered numbers (red +1, white 0, blue -1).
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import pathjax as pj
from pathjax.images import linear_to_srgb
from pathjax.inverse import report

NAMES = ["glass.int_ior", "pattern.color0", "pattern.color1"]
CAMERAS = ["0, 0, 4", "1.6, 0.4, 3.6", "-1, 1.2, 3.7"]
START = {"glass.int_ior": 1.2, "pattern.color0": 0.5, "pattern.color1": 0.5}


def correlation_picture(fit, width, cell=34):
    """Draw the correlation matrix as labelled squares."""
    n = len(fit.components)
    picture = Image.new("RGB", (width, cell * n + 2 * cell), "white")
    draw = ImageDraw.Draw(picture)
    for i in range(n):
        draw.text((8, cell * (i + 1) + cell // 3), fit.components[i], fill="black")
        for j in range(n):
            c = float(np.nan_to_num(fit.correlation[i, j]))
            fade = round(255 * (1 - abs(c)))
            color = (255, fade, fade) if c > 0 else (fade, fade, 255)
            corner = 130 + cell * j, cell * (i + 1)
            draw.rectangle([*corner, corner[0] + cell - 2, corner[1] + cell - 2], fill=color, outline="gray")
            draw.text((corner[0] + 3, corner[1] + cell // 3), f"{c:+.2f}", fill="black")
    return picture


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=64)
    parser.add_argument("--target-spp", type=int, default=512)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("-o", "--output", default="three_views.png")
    options = parser.parse_args()

    file = Path(__file__).parents[1] / "scenes" / "glass_ball.xml"
    views = [pj.load_scene(file, res=options.res, **{"from": camera}) for camera in CAMERAS]
    targets = [np.asarray(pj.render(view, options.target_spp, seed=1 + i)) for i, view in enumerate(views)]
    fit = pj.fit(views, targets, NAMES, start=START, spp=options.spp)
    print(report.text(fit))

    views_shown = Image.fromarray((linear_to_srgb(np.clip(report.picture(fit, targets), 0, 1)) * 255).astype(np.uint8))
    below = correlation_picture(fit, views_shown.width)
    whole = Image.new("RGB", (views_shown.width, views_shown.height + below.height), "white")
    whole.paste(views_shown, (0, 0))
    whole.paste(below, (0, views_shown.height))
    whole.save(options.output)


if __name__ == "__main__":
    main()
