"""Register a bsdf of your own, check it, use it in a scene, and recover its roughness from an image."""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.core.types import BSDFSample
from pathjax.core.warp import square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.images import write_png
from pathjax.kinds import Color, Number


@bsdfs.register("oren_nayar")
class OrenNayar(bsdfs.BSDF):
    """Rough clay: the model of Oren and Nayar (1994) in Fujii's form, which loses less energy."""

    reflectance = Color(0.5)
    sigma = Number(0.5, bounds=(0, 1))
    smooth = True

    @staticmethod
    def evaluate(p, wi, wo):
        cos_i, cos_o = wi[2], jnp.maximum(wo[2], 0)
        s = wi[0] * wo[0] + wi[1] * wo[1]
        t = jnp.where(s > 0, jnp.maximum(jnp.maximum(cos_i, cos_o), jnp.finfo(s.dtype).tiny), 1)
        scale = 1 / (math.pi + (math.pi / 2 - 2 / 3) * p.sigma)
        return p.reflectance * (scale * (1 + p.sigma * s / t) * cos_o), square_to_cosine_hemisphere_pdf(wo)

    @staticmethod
    def sample(p, wi, u):
        wo = square_to_cosine_hemisphere(u)
        f, pdf = OrenNayar.evaluate(p, wi, wo)
        weight = jnp.where(pdf > 0, f / jnp.where(pdf > 0, pdf, 1), 0)
        return BSDFSample(wo, weight, pdf, jnp.bool_(False), jnp.ones_like(pdf))


SCENE = """<scene version="3.0.0">
  <default name="res" value="64"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <float name="fov" value="40"/>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/></film>
  </sensor>
  <shape type="sphere">
    <bsdf type="oren_nayar" id="clay"><rgb name="reflectance" value="0.8, 0.5, 0.3"/></bsdf>
  </shape>
  <shape type="sphere">
    <point name="center" x="3" y="2" z="6"/><emitter type="area"><rgb name="radiance" value="20"/></emitter>
  </shape>
</scene>"""
TRUTH = 0.35


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--res", type=int, default=64)
    parser.add_argument("--target-spp", type=int, default=4096)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("-o", "--output", default="own_bsdf.png")
    options = parser.parse_args()

    testing.check_bsdf(OrenNayar, sigma=0.7)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "clay.xml"
        file.write_text(SCENE)
        scene = pj.load_scene(file, res=options.res)
    target = pj.render(pj.with_parameters(scene, {"clay.sigma": TRUTH}), options.target_spp, seed=1)
    fit = pj.fit(scene, np.asarray(target), ["clay.sigma"], spp=options.spp, seed=2)
    value, error = fit.values["clay.sigma"], fit.standard_errors["clay.sigma"]
    print(f"sigma: {TRUTH} in the target, fitted {value:.4f} +- {error:.4f}; {fit.message}")
    write_png(options.output, np.concatenate([target, fit.images[0]], axis=1))


if __name__ == "__main__":
    main()
