"""Find what an image does not determine: the brightness of a lamp and the albedos that it lights directly.

    python examples/identifiability.py

With one bounce, an image determines only the product of the two, as long as the lamp itself is not visible. `fit` names
the direction along which the image does not change, and gives infinite errors instead of false confidence. With more
bounces, indirect light reveals the albedos, and the same fit succeeds. Writes identifiability.png: both fits.
"""

import argparse
from pathlib import Path

import numpy as np

import pathjax as pj
from pathjax.images import write_png
from pathjax.inverse import report

NAMES = ["lamp.radiance", "floor.reflectance", "wall.reflectance"]
SCENE = """<scene version="3.0.0">
  <default name="max_depth" value="2"/>
  <integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>
  <sensor type="perspective"><float name="fov" value="35"/>
    <transform name="to_world"><lookat origin="3, 2, 4" target="0, 0.6, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
      <rfilter type="box"/></film></sensor>
  <bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf>
  <bsdf type="diffuse" id="wall"><rgb name="reflectance" value="0.2, 0.4, 0.7"/></bsdf>
  <shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform>
    <ref id="floor"/></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="2"/><translate y="2" z="-2"/></transform>
    <ref id="wall"/></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="0.5"/><rotate x="1" angle="90"/>
    <translate y="4"/></transform>
    <emitter type="area" id="lamp"><rgb name="radiance" value="20, 20, 20"/></emitter></shape>
</scene>"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=48)
    parser.add_argument("--target-spp", type=int, default=2048)
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("-o", "--output", default="identifiability.png")
    options = parser.parse_args()

    file = Path(options.output).with_suffix(".xml")
    file.write_text(SCENE)
    pictures = []
    for depth in (2, 8):
        scene = pj.load_scene(file, res=options.res, max_depth=depth)
        target = np.asarray(pj.render(scene, options.target_spp, seed=1))
        start = {"lamp.radiance": 10.0, "floor.reflectance": 0.5, "wall.reflectance": 0.5}
        fit = pj.fit(scene, target, NAMES, start=start, spp=options.spp)
        print(f"\nlight of up to {depth - 1} bounces:\n{report.text(fit)}")
        pictures.append(report.picture(fit, [target]))
    write_png(options.output, np.concatenate(pictures))


if __name__ == "__main__":
    main()
