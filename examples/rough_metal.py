"""Recover the roughness and the colour of a metal from one photograph of a ball under a sky with windows.

    python examples/rough_metal.py

Roughness blurs the reflections, and colour scales them. The windows distinguish the two, and `fit` finds both from each
of four starts. Under a uniform sky there is nothing to blur: a rougher ball is only a little darker, and so is one of a
darker colour. For a polished ball under such a sky, the fit reports that the image does not determine which of the two
it is. Writes rough_metal.png: target, fit and residual of both.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import pathjax as pj
from pathjax.images import write_exr, write_png
from pathjax.inverse import report

NAMES = ["metal.alpha", "metal.specular_reflectance"]
COLOR = [0.9, 0.6, 0.3]
STARTS = [(0.05, 0.5), (0.05, 0.9), (0.5, 0.5), (0.5, 0.9)]
SCENE = """<scene version="3.0.0">
  <default name="res" value="64"/>
  <default name="sky" value="sky.exr"/>
  <integrator type="path"><integer name="max_depth" value="2"/></integrator>
  <sensor type="perspective"><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="0, 0, 4.2" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
      <rfilter type="box"/></film></sensor>
  <shape type="sphere"><bsdf type="roughconductor" id="metal"><string name="distribution" value="ggx"/>
    <float name="alpha" value="0.15"/><rgb name="specular_reflectance" value="0.9, 0.6, 0.3"/></bsdf></shape>
  <emitter type="envmap"><string name="filename" value="$sky"/></emitter>
</scene>"""


def sky(windows):
    """Return (16, 32, 3) radiances: a grey room, with windows of several colours or without."""
    image = np.full((16, 32, 3), 0.4)
    for top, left, color in [(3, 2, (4, 5, 6)), (4, 10, (6, 5, 4)), (3, 20, (5, 5, 5)), (9, 27, (2, 4, 2))] * windows:
        image[top : top + 4, left : left + 3] = color
    return image.astype(np.float32)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=64)
    parser.add_argument("--target-spp", type=int, default=1024)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("-o", "--output", default="rough_metal.png")
    options = parser.parse_args()

    pictures = []
    for windows, alpha in ((True, 0.15), (False, 0.03)):
        with tempfile.TemporaryDirectory() as folder:
            write_exr(Path(folder) / "sky.exr", dict(zip("RGB", np.moveaxis(sky(windows), -1, 0), strict=True)), {})
            (Path(folder) / "ball.xml").write_text(SCENE)
            scene = pj.load_scene(Path(folder) / "ball.xml", res=options.res)
        truth = pj.with_parameters(scene, dict(zip(NAMES, (alpha, COLOR), strict=True)))
        target = np.asarray(pj.render(truth, options.target_spp, seed=1))
        print(f"\nalpha {alpha} under a sky {'with' if windows else 'without'} windows:")
        for start in STARTS if windows else STARTS[:1]:
            begin = dict(zip(NAMES, start, strict=True))
            fit = pj.fit(scene, target, NAMES, start=begin, spp=options.spp, seed=2)
            print(f"from alpha {start[0]} and colour {start[1]}:\n{report.text(fit)}")
        pictures.append(report.picture(fit, [target]))
    write_png(options.output, np.concatenate(pictures))


if __name__ == "__main__":
    main()
