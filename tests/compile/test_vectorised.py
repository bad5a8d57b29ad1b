"""All public functions in the form for accelerators, which a CPU takes where native loops are off."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import numpy as np
import pytest

BEGIN = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
import pathjax as pj
from pathjax.compile import mapping, native

form, asked = mapping._form, set()

def ask(given):
    frame = sys._getframe()
    while frame:
        asked.add(frame.f_code.co_filename)
        frame = frame.f_back
    return form(given)

mapping._form = ask
folder, out = sys.argv[1:]

def load(name, **how):
    return pj.load_scene(f"{folder}/{name}.xml", **how)
"""
END = """
leaves, _ = jax.tree_util.tree_flatten_with_path(results)
results = {jax.tree_util.keystr(path): np.asarray(x) for path, x in leaves}
np.savez(out, **results, native=native(), asked=sorted(asked))
"""
PLATE = """
film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
view = {"type": "perspective", "film": film, "to_world": pj.Transform().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])}
scene = pj.load_dict({
    "type": "scene", "view": view, "sky": {"type": "constant"},
    "plate": {"type": "rectangle", "bsdf": {"type": "diffuse", "id": "grey"}},
})
image, J = pj.jacobian(scene, list(pj.parameters(scene)), 4, 1)
results = {"image": image, "J": J.derivatives}
"""
EVERYTHING = """
from pathjax import transport
from pathjax.integrators import reference
from pathjax.scene import parameters as named

box = load("scenes/cornell_box", res=8)
glass = load("scenes/glass_ball", res=8)
rays = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
colors = {"white.reflectance": jnp.full(3, 0.5), "light.radiance": jnp.ones(3)}
seen, J = pj.jacobian(glass, list(pj.parameters(glass)), 4, 1)
results = {
    "jacobian": (seen, J.derivatives), "variables": pj.render_aovs(glass, ["depth", "albedo"]),
    "until": pj.render_until(box, spp=4, seed=1).image, "terms": pj.render_bounces(box, 3, spp=4, seed=1).terms,
    "hits": pj.closest_hit(box, *rays).t, "any": pj.any_hit(box, *rays),
}
image, push = jax.jvp(lambda v: pj.render(pj.with_parameters(box, v), 4, 1), (colors,), (colors,))
normal = pj.normal_equations(box, list(colors), 1.1 * image, spp=4)
operator = transport.operator(box, 60, rays=8)
by_rays = transport.operator(box, 60, method="rays", rays=64)
view = transport.image(box, operator.radiosity(operator.solve().L), spp=2)
wide = load("tests/scenes/shapes_and_filters", res=8)
textured = load("tests/scenes/textures", res=8)
texture = next(name for name, x in pj.parameters(textured).items() if np.ndim(x) == 3)
texels = pj.parameters(textured)[texture]
rows = pj.jacobian(textured, [texture], 4, 1)[1][texture]
seen, pull = jax.vjp(lambda v: pj.render(pj.with_parameters(textured, {texture: v}), 4, 1), texels)
results |= {
    "image": image, "J v": push, "normal": (normal.matrix, normal.gradient), "solution": operator.solve().L,
    "view": view, "by rays": by_rays.solve().L, "J in texels": rows,
    "samples": reference.samples(named.nameless(box), 2, 1),
    "shared samples": pj.render(wide, 4, 1), "J^T v": pull(seen),
}
"""


@pytest.fixture
def both_forms(root, tmp_path):
    """(script) -> its results in lanes and in the form for accelerators, and the files that requested a kernel."""

    def both(script):
        results = []
        for native in "10":
            out = tmp_path / f"{native}.npz"
            environment = {**os.environ, "PATHJAX_NATIVE_LOOPS": native, "PYTHONPATH": str(root)}
            environment.pop("XLA_FLAGS", None)  # set by this process, which has native loops
            command = [sys.executable, "-c", BEGIN + script + END, str(root), str(out)]
            subprocess.run(command, check=True, env=environment, cwd=tmp_path)
            results.append(dict(np.load(out)))
        assert [bool(result.pop("native")) for result in results] == [True, False]
        asked = [set(result.pop("asked")) for result in results]
        return *results, asked[1]

    return both


def assert_alike(lanes, vmap):
    """Where rounding tips a decision a path takes another course, so a few values may differ completely."""
    assert lanes.keys() == vmap.keys() and lanes
    for key, value in lanes.items():
        largest = np.abs(value[np.isfinite(value)]).max(initial=0)
        close = np.isclose(value, vmap[key], rtol=1e-3, atol=1e-4 * largest)
        assert close.mean() > 0.95 if close.size else True, key


def test_an_image_and_its_jacobian_agree_with_native_loops(both_forms):
    lanes, vmap, _ = both_forms(PLATE)
    assert_alike(lanes, vmap)


@pytest.mark.slow
def test_every_kernel_of_the_package_agrees_with_native_loops(both_forms, root):
    lanes, vmap, asked = both_forms(EVERYTHING)
    assert_alike(lanes, vmap)
    asks = re.compile(r"\b(native_map|native_fold|native_rows|map_pixels)\(")
    files = [path for path in (root / "pathjax").rglob("*.py") if path.parent.name != "compile"]
    assert not {str(path) for path in files if asks.search(path.read_text())} - asked
