"""Check the derivatives of another renderer: one of Mitsuba's that is right, and one that is wrong.

    python examples/check_mitsuba.py

With respect to an albedo, Mitsuba's `prb` is right. With respect to the position of the ball it is not: it moves the
shading, but not the outlines of the ball and of its shadow, as its documentation says; `prb_projective` adds these.
`check_gradient` knows nothing of this and detects it from images alone. Writes check_mitsuba.png: for each case the
claimed derivative, the differences of images, and their disagreement in standard errors (red: too large, blue: too
small). Needs Mitsuba: pip install 'pathjax[bench]'.
"""

import argparse
import sys

import numpy as np

import pathjax as pj
from pathjax.images import write_png

# Integrator, and what theta is.
CASES = [("prb", "albedo"), ("prb", "place"), ("prb_projective", "place")]
FAULTS = 6  # disagreement in standard errors at which the colours saturate


def ball_on_a_floor(mi, integrator, res):
    at = mi.ScalarTransform4f
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    film = {"type": "hdrfilm", "width": res, "height": res, "rfilter": {"type": "box"}, "sample_border": True}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": at().look_at(origin=[0, 2, 4], target=[0, 0, 0], up=[0, 1, 0]),
                "film": film,
            },
            "floor": {
                "type": "rectangle",
                "to_world": at().translate([0, -0.7, 0]).rotate([1, 0, 0], -90).scale(3),
                "bsdf": grey,
            },
            "ball": {"type": "sphere", "radius": 0.7, "bsdf": grey},
            "lamp": {
                "type": "sphere",
                "center": [2, 3, 1],
                "radius": 0.3,
                "emitter": {"type": "area", "radiance": 20.0},
            },
        }
    )


class Mitsuba:
    """A renderer with one parameter, for `check_gradient`: the albedo of the ball, or its shift to the right."""

    def __init__(self, mi, integrator, what, res, spp):
        self.mi, self.what, self.spp = mi, what, spp
        self.scene = ball_on_a_floor(mi, integrator, res)
        self.parameters = mi.traverse(self.scene)

    def set(self, theta):
        mi = self.mi
        if self.what == "albedo":
            self.parameters["ball.bsdf.reflectance.value"] = mi.Color3f(theta)
        else:
            self.parameters["ball.to_world"] = mi.Transform4f().translate(
                mi.Vector3f(theta, 0, 0)
            ) @ mi.Transform4f().scale(0.7)
        self.parameters.update()

    def image(self, theta, seed):
        self.set(self.mi.Float(float(theta)))
        return np.array(self.mi.render(self.scene, spp=self.spp, seed=seed))

    def derivative(self, theta, v, seed):
        import drjit as dr

        x = self.mi.Float(float(theta))
        dr.enable_grad(x)
        self.set(x)
        dr.set_grad(x, float(v))
        dr.enqueue(dr.ADMode.Forward, x)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        image = self.mi.render(self.scene, self.parameters, spp=self.spp, seed=seed)
        return np.array(dr.forward_to(image))


def colored(values, largest):
    """Map (H, W) values to colours: red above 0, blue below, white at 0."""
    share = np.clip(values / largest, -1, 1)[..., None]
    red, blue = np.array([0.8, 0.05, 0.05]), np.array([0.05, 0.15, 0.8])
    return np.where(share > 0, 1 + share * (red - 1), 1 - share * (blue - 1))


def panels(check):
    derivative, difference, z = (x.mean(-1) for x in (check.derivative, check.difference, check.z))
    largest = np.quantile(abs(difference), 0.99) or 1
    side = len(difference) // len(z)
    maps = (
        colored(derivative, largest),
        colored(difference, largest),
        colored(np.kron(z, np.ones((side, side))), FAULTS),
    )
    return np.concatenate(maps, axis=1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=64, help="a multiple of 8")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("-o", "--output", default="check_mitsuba.png")
    options = parser.parse_args()
    try:
        import mitsuba as mi
    except ModuleNotFoundError:
        print("Mitsuba is not installed, so there is nothing to check; pip install 'pathjax[bench]'", file=sys.stderr)
        return
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)

    rows = []
    for integrator, what in CASES:
        theta, bounds, reach = {"albedo": (0.5, (0, 1), None), "place": (0.0, None, 0.02)}[what]
        renderer = Mitsuba(mi, integrator, what, options.res, options.spp)
        check = pj.check_gradient(
            renderer.image, theta, derivative=renderer.derivative, bounds=bounds, reach=reach, seeds=options.seeds
        )
        verdict = "passes" if check.passed else "is wrong"
        print(
            f"{integrator} in the {what} of the ball {verdict}: the largest of {check.z.size} |z| is "
            f"{np.abs(check.z).max():.1f}, p = {check.p_value:.1e}; it would find an error of {check.resolution:.1%}"
        )
        rows.append(panels(check))
    write_png(options.output, np.concatenate(rows))


if __name__ == "__main__":
    main()
