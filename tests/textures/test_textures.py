"""Textures against NumPy and against Mitsuba."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax import testing, textures
from pathjax.kinds import Color, Parameters
from pathjax.textures import Bitmap, Checkerboard
from pathjax.textures.bitmap import WRAPS


def bitmap(h, w, seed=0, to_uv=None, **how):
    texels = np.random.default_rng(seed).random((h, w, 3)).astype(np.float32)
    return Bitmap.instance(f"b{seed}", texels=texels, to_uv=to_uv, **how)


def checkerboard(to_uv=None, name="c"):
    colors = {"color0": np.array([0.1, 0.2, 0.3]), "color1": np.array([0.9, 0.8, 0.7])}
    return Checkerboard.instance(name, to_uv=to_uv, **colors)


def wrapped(i, n, wrap):
    if wrap == "repeat":
        return i % n
    if wrap == "clamp":
        return np.clip(i, 0, n - 1)
    i = i % (2 * n)
    return np.where(i < n, i, 2 * n - 1 - i)


def reference(tex, uv):
    """Look up a texture in NumPy: uv (N, 2) -> colours (N, 3), float64."""
    made, tex = tex, SimpleNamespace(**tex.values)
    if tex.to_uv is not None:
        uv = np.c_[uv, np.ones(len(uv))] @ tex.to_uv.T
    if made.kind is Checkerboard:
        odd = uv - np.floor(uv) > 0.5
        return np.where((odd[:, 0] == odd[:, 1])[:, None], tex.color0, tex.color1)
    h, w, _ = tex.texels.shape
    wrap = tex.wrap or "repeat"
    x, y = uv[:, 0] * w, uv[:, 1] * h

    def texel(j, i):
        return tex.texels[wrapped(i.astype(int), h, wrap), wrapped(j.astype(int), w, wrap)].astype(float)

    if tex.nearest:
        return texel(np.floor(x), np.floor(y))
    x, y = x - 0.5, y - 0.5
    j, i = np.floor(x), np.floor(y)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    top = texel(j, i) * (1 - fx) + texel(j + 1, i) * fx
    bottom = texel(j, i + 1) * (1 - fx) + texel(j + 1, i + 1) * fx
    return top * (1 - fy) + bottom * fy


def lookup_all(made, uv):
    table, codes = textures.build(made, np.float32, (), Parameters())
    table = jax.device_put(table)
    numbers = jnp.array([codes[each] for each in made])

    def of(code, uv):
        return table.look_up(code, SimpleNamespace(uv=uv))

    look = jax.vmap(jax.vmap(of, (None, 0)), (0, None))
    return np.asarray(jax.jit(look)(numbers, jnp.asarray(uv, jnp.float32)))


def random_uv(n=5000):
    """Points in and around the unit square, none within float32 rounding of a texel's border."""
    uv = np.random.default_rng(3).uniform(-3, 3, (n, 2))
    return (np.floor(uv * 420) + 0.5) / 420


TO_UV = np.array([[2.0, 0.5, 0.25], [-0.5, 3.0, -0.125]])


def test_bitmaps_are_those_of_numpy():
    """All wrap modes and both filters are in one table, with images of different sizes."""
    kinds = [(i, w) for i in ("bilinear", "nearest") for w in WRAPS]
    made = [bitmap(3 + k, 7 - k, k, nearest=i == "nearest", wrap=w) for k, (i, w) in enumerate(kinds)]
    uv = random_uv()
    found = lookup_all(made, uv)
    for tex, colors in zip(made, found, strict=True):
        # Rounding of texel coordinates, which are up to 3 times a size of 8.
        tolerance = 1e-5
        wrong = np.abs(colors - reference(tex, uv)).max(1) > tolerance
        if tex.values["nearest"]:
            size = np.array(tex.values["texels"].shape[1::-1])
            place = np.float64(np.float32(uv)) * size
            wrong &= np.abs(place - np.round(place)).min(1) > 1e-5  # on a border either texel is right
        assert not wrong.any(), (tex.values["nearest"], tex.values["wrap"], uv[wrong][:3])


def test_to_uv_is_applied_before_the_look_up():
    made = [bitmap(4, 5, to_uv=TO_UV), checkerboard(TO_UV)]
    uv = np.random.default_rng(5).uniform(-2, 2, (5000, 2))
    place = (np.c_[uv, np.ones(len(uv))] @ TO_UV.T) * 2
    clear = np.abs(place - np.round(place)).min(1) > 1e-4  # away from the checkerboard's borders
    for tex, colors in zip(made, lookup_all(made, uv), strict=True):
        np.testing.assert_allclose(colors[clear], reference(tex, uv)[clear], atol=2e-5)


def test_checkerboard_starts_with_color0_and_repeats():
    colors = lookup_all([checkerboard()], [[0.2, 0.2], [0.7, 0.2], [0.2, 0.7], [0.7, 0.7], [-0.2, 0.2], [1.2, 5.2]])[0]
    np.testing.assert_allclose(colors[:, 0], np.float32([0.1, 0.9, 0.9, 0.1, 0.9, 0.1]))


@pytest.mark.parametrize("holds", ["numbers", "a board"])
def test_a_board_of_numbers_is_that_of_mitsuba(holds):
    """Mitsuba's `eval_1` starts with the other colour than its `eval`."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    inner, theirs = 0.7, 0.7
    if holds == "a board":
        inner = Checkerboard.instance("inner", color0=0.2, color1=0.3, to_uv=np.diag([3.0, 3.0, 1.0])[:2])
        scaled = mi.ScalarTransform3f(np.diag([3.0, 3, 1]))
        theirs = {"type": "checkerboard", "color0": 0.2, "color1": 0.3, "to_uv": scaled}
    ours = Checkerboard.instance("outer", color0=0.1, color1=inner, to_uv=TO_UV)
    transform = mi.ScalarTransform3f(np.concatenate([TO_UV, [[0, 0, 1]]]))
    theirs = mi.load_dict({"type": "checkerboard", "color0": 0.1, "color1": theirs, "to_uv": transform})
    uv = np.random.default_rng(8).random((300, 2))
    si = mi.SurfaceInteraction3f()
    expected = []
    for si.uv in uv.tolist():
        expected.append(theirs.eval_1(si))
    known = {}
    found = lookup_all([textures.of_number(ours, known)], uv)[0][:, 0]
    assert (np.abs(found - expected) < 1e-6).mean() > 0.99  # except for rounding at borders
    assert textures.of_number(ours, known) is known[ours]


def nested():
    """Return a checkerboard of an image and a checkerboard that holds a third one."""
    inner = Checkerboard.instance("inner", color0=checkerboard(), color1=0.5, to_uv=np.diag([5.0, 3.0, 1.0])[:2])
    outer = np.array([[2.0, 0, 0.1], [0, 1.5, 0.2]])
    return Checkerboard.instance("outer", color0=bitmap(4, 6), color1=inner, to_uv=outer)


def test_a_board_of_textures_looks_them_up_at_the_uv_of_the_surface():
    """In a table with other textures, some of which it also holds."""
    board = nested()
    image, inner = board.values["color0"], board.values["color1"]
    uv = random_uv()
    found = lookup_all([checkerboard(TO_UV, "other"), inner, board, image], uv)
    plain = {"color0": np.zeros(3), "color1": np.ones(3)}
    where = reference(Checkerboard.instance("", to_uv=board.values["to_uv"], **plain), uv)
    where_inner = reference(Checkerboard.instance("", to_uv=inner.values["to_uv"], **plain), uv)
    expected_inner = np.where(where_inner > 0, 0.5, reference(inner.values["color0"], uv))
    expected = np.where(where > 0, expected_inner, reference(image, uv))
    places = [(np.c_[uv, np.ones(len(uv))] @ each.values["to_uv"].T) * 2 for each in (board, inner)]
    clear = np.all([np.abs(place - np.round(place)).min(1) > 1e-4 for place in places], axis=0)
    np.testing.assert_allclose(found[1][clear], expected_inner[clear], atol=2e-5)
    np.testing.assert_allclose(found[2][clear], expected[clear], atol=2e-5)
    np.testing.assert_allclose(found[3], reference(image, uv), atol=2e-5)
    assert Checkerboard.span(board) == (min(image.values["texels"].min(), 0.1), max(image.values["texels"].max(), 0.9))


def test_kinds_stand_beside_each_other_in_float64(x64):
    with x64():
        made = [textures.Uniform.instance("u", value=0.3), checkerboard()]
        np.testing.assert_allclose(lookup_all(made, [[0.2, 0.2]])[:, 0], [[0.3] * 3, [0.1, 0.2, 0.3]], rtol=1e-6)


def test_a_uniform_texture_is_one_number_of_all_channels():
    testing.check_texture(textures.Uniform, value=0.3)
    made = [textures.Uniform.instance("u", value=0.3), checkerboard()]
    np.testing.assert_allclose(lookup_all(made, [[0.2, 0.7]])[0], [[0.3] * 3], rtol=1e-6)


def test_bilinear_derivative_in_uv_is_the_slope():
    table, _ = textures.build([bitmap(4, 4)], np.float32, (), Parameters())
    table = jax.device_put(table)
    uv = jnp.array([0.4, 0.55])
    slope = jax.jit(jax.jacfwd(lambda uv: table.look_up(jnp.zeros(2, jnp.int32), SimpleNamespace(uv=uv))))(uv)
    h = 1e-3
    ends = [reference(bitmap(4, 4), np.float64(uv)[None] + s * h * e)[0] for e in np.eye(2) for s in (1, -1)]
    numeric = np.stack([(ends[0] - ends[1]), (ends[2] - ends[3])], -1) / (2 * h)
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["checkerboard", "bilinear", "nearest"])
def test_textures_are_those_of_mitsuba(kind):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    transform = mi.ScalarTransform3f(np.concatenate([TO_UV, [[0, 0, 1]]]))
    if kind == "checkerboard":
        ours, more = checkerboard(TO_UV), {"color0": color([0.1, 0.2, 0.3]), "color1": color([0.9, 0.8, 0.7])}
    else:
        ours = bitmap(4, 6, to_uv=TO_UV, nearest=kind == "nearest", wrap="mirror")
        image = mi.Bitmap(ours.values["texels"])
        more = {"bitmap": image, "raw": True, "filter_type": kind, "wrap_mode": "mirror"}
    theirs = mi.load_dict({"type": "checkerboard" if kind == "checkerboard" else "bitmap", "to_uv": transform, **more})
    uv = np.random.default_rng(7).random((300, 2))
    place = (np.c_[uv, np.ones(len(uv))] @ TO_UV.T) * np.array([12, 12])  # the borders of all three textures
    uv = uv[np.abs(place - np.round(place)).min(1) > 1e-3]
    si = mi.SurfaceInteraction3f()
    expected = []
    for u, v in uv:
        si.uv = [u, v]
        expected.append(np.asarray(theirs.eval(si)).ravel())
    np.testing.assert_allclose(lookup_all([ours], uv)[0], expected, atol=2e-5)


def color(rgb):
    return {"type": "rgb", "value": rgb}


SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>
  <shape type="rectangle"><bsdf type="diffuse"><texture type="KIND" name="reflectance" id="it"/></bsdf></shape>
  <emitter type="constant"/>
</scene>"""


class Ramp(textures.Texture):
    """A ramp from one colour to another along u."""

    left = Color(0.2, textured=False)
    right = Color(0.8, textured=False)

    @staticmethod
    def look_up(p, uv, surface):
        return p.left + uv[0] * (p.right - p.left)


def test_a_users_texture_is_rendered_and_differentiated(tmp_path, monkeypatch):
    monkeypatch.setattr(textures, "KINDS", dict(textures.KINDS))
    textures.register("ramp")(Ramp)
    (tmp_path / "scene.xml").write_text(SCENE.replace("KIND", "ramp"))
    scene = pj.load_scene(tmp_path / "scene.xml")
    scene = pj.with_parameters(scene, {"it.left": [0.0, 0, 0]})
    image, jacobian = pj.jacobian(scene, ["it.left", "it.right"], spp=64)
    lit = np.asarray(image)[3:5, 3:5, 0]
    # One bounce under a sky of 1: the image is the texture, and its derivatives are the shares of the two colours.
    np.testing.assert_allclose(lit.mean(), 0.4, atol=0.01)
    shares = [np.asarray(jacobian[name])[3:5, 3:5, 0, 0].mean() for name in ("it.left", "it.right")]
    np.testing.assert_allclose(shares, [0.5, 0.5], atol=0.02)
