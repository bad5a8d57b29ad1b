"""A bsdf of one's own: declared, checked, used in a scene, rendered, and its parameter fitted."""

import math

import jax.numpy as jnp
import numpy as np

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.core.types import BSDFSample
from pathjax.core.warp import square_to_cosine_hemisphere, square_to_cosine_hemisphere_pdf
from pathjax.kinds import Color, Number


@bsdfs.register("oren_nayar")
class OrenNayar(bsdfs.BSDF):
    """Rough clay (Oren and Nayar 1994, in the form of Fujii 2020, which loses less light)."""

    reflectance = Color(0.5)
    sigma = Number(0.5, bounds=(0, 1))
    smooth = True

    @staticmethod
    def evaluate(p, wi, wo):
        cos_i, cos_o = wi[2], jnp.maximum(wo[2], 0)
        s = wi[0] * wo[0] + wi[1] * wo[1]
        t = jnp.where(s > 0, jnp.maximum(jnp.maximum(cos_i, cos_o), 1e-7), 1)
        a = 1 / (math.pi + (math.pi / 2 - 2 / 3) * p.sigma)
        f = p.reflectance * a * (1 + p.sigma * s / t)
        return f * cos_o, square_to_cosine_hemisphere_pdf(wo)

    @staticmethod
    def sample(p, wi, u):
        wo = square_to_cosine_hemisphere(u)
        f, pdf = OrenNayar.evaluate(p, wi, wo)
        weight = jnp.where(pdf > 0, f / jnp.where(pdf > 0, pdf, 1), 0)
        return BSDFSample(wo, weight, pdf, jnp.bool_(False), jnp.ones_like(pdf))


SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <float name="fov" value="40"/>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film>
  </sensor>
  <shape type="sphere">
    <bsdf type="oren_nayar" id="clay"><rgb name="reflectance" value="0.8, 0.5, 0.3"/></bsdf>
  </shape>
  <shape type="sphere">
    <float name="radius" value="0.5"/><point name="center" value="0, 0, 6"/>
    <emitter type="area"><rgb name="radiance" value="20"/></emitter>
  </shape>
</scene>"""


def main(folder="."):
    testing.check_bsdf(OrenNayar, sigma=0.7)
    file = f"{folder}/clay.xml"
    with open(file, "w") as f:
        f.write(SCENE)
    scene = pj.load_scene(file)
    truth = 0.35
    target = np.asarray(pj.render(pj.with_parameters(scene, {"clay.sigma": truth}), spp=4096, seed=1))
    fit = pj.fit(scene, target, ["clay.sigma"], seed=2)
    print(f"sigma = {fit.values['clay.sigma']:.4f} +- {fit.standard_errors['clay.sigma']:.4f}, rendered with {truth}")
    return fit


if __name__ == "__main__":
    main()
