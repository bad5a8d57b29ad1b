"""Output variables (AOVs) against closed forms, and against Mitsuba's."""

import subprocess
import sys

import numpy as np
import pytest

import pathjax as pj

NAMES = ["depth", "normal", "albedo"]
RHO = np.float32([0.2, 0.5, 0.8])
GREY = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
GLASS = '<bsdf type="dielectric"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/></bsdf>'
MIRROR = '<bsdf type="conductor"><rgb name="specular_reflectance" value="0.9, 0.5, 0.25"/></bsdf>'
AWAY = '<transform name="to_world"><rotate y="1" angle="180"/></transform>'
LAMP = '<emitter type="area"><rgb name="radiance" value="1"/></emitter>'


def plate(inside):
    return f'<shape type="rectangle">{inside}</shape>'


@pytest.mark.parametrize(
    "inside, normal, albedo",
    [
        (GREY, 1, RHO),
        (AWAY + GREY, -1, [0, 0, 0]),
        (AWAY + f'<bsdf type="twosided">{GREY}</bsdf>', -1, RHO),
        (f'<boolean name="flip_normals" value="true"/>{GREY}', -1, [0, 0, 0]),
        (GLASS, 1, [1, 1, 1]),
        (AWAY + GLASS, -1, [1, 1, 1]),
        (MIRROR, 1, [0.9, 0.5, 0.25]),
    ],
)
def test_a_plate_that_fills_the_view(make_scene, inside, normal, albedo):
    """The plate is 4 from the camera; depth starts at the near clip plane, 0.01 from the camera."""
    aovs = pj.render_aovs(make_scene(plate(inside), fov=0.1), NAMES)
    assert {name: image.shape for name, image in aovs.items()} == {
        "depth": (16, 16, 1),
        "normal": (16, 16, 3),
        "albedo": (16, 16, 3),
    }
    np.testing.assert_allclose(aovs["depth"], 3.99, rtol=1e-5)
    np.testing.assert_allclose(aovs["normal"], np.broadcast_to([0, 0, normal], (16, 16, 3)), atol=1e-6)
    np.testing.assert_allclose(aovs["albedo"], np.broadcast_to(albedo, (16, 16, 3)), rtol=1e-5)


def test_normals_of_a_sphere_point_outwards(make_scene):
    """At grazing rays depth and normal vary within a pixel, so only the middle is compared."""
    aovs = pj.render_aovs(make_scene(f'<shape type="sphere">{GREY}</shape>', fov=20), NAMES, spp=4)
    y, x = np.mgrid[:16, :16] - 7.5
    d = np.stack([x, -y, np.full_like(x, -8 / np.tan(np.radians(10)))], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d[..., 2] * 4
    t = -b - np.sqrt(b**2 - 15)
    normal = np.array([0, 0, 4]) + t[..., None] * d
    np.testing.assert_allclose(aovs["normal"][6:10, 6:10], normal[6:10, 6:10], atol=0.03)
    np.testing.assert_allclose(aovs["depth"][6:10, 6:10, 0], (t + 0.01 / d[..., 2])[6:10, 6:10], atol=0.01)


def test_misses_are_0(make_scene):
    for scene in (make_scene(""), make_scene(plate(GREY), origin="0, 0, 4", target="0, 0, 8")):
        assert not any(image.any() for image in pj.render_aovs(scene, NAMES).values())


@pytest.mark.parametrize("spp", [1, 3, 16])
def test_film_positions_are_those_of_the_image(make_scene, spp):
    """A lamp seen directly: the image is its share of the pixel, and the albedo that share times the lamp's albedo."""
    scene = make_scene(f'<shape type="disk">{GREY}{LAMP}</shape>', depth=1, fov=40)
    image = pj.render_until(scene, spp=spp, seed=5).image
    albedo = pj.render_aovs(scene, ["albedo"], spp=spp, seed=5)["albedo"]
    assert 0 < (image < 0.99).mean() < 1
    np.testing.assert_allclose(albedo, image * RHO, rtol=1e-5)


def test_more_than_16_samples_are_not_taken(make_scene):
    scene = make_scene(f'<shape type="disk">{GREY}</shape>')
    few, many = (pj.render_aovs(scene, ["depth"], spp=spp)["depth"] for spp in (16, 10**6))
    np.testing.assert_array_equal(few, many)


def test_hidden_lamps_let_the_camera_through(make_scene):
    lamp = plate(f'<transform name="to_world"><translate z="1"/></transform>{GREY}{LAMP}')
    shown, hidden = (make_scene(plate(MIRROR) + lamp, hide=hide, fov=0.1) for hide in ("false", "true"))
    for scene, depth, albedo in ((shown, 2.99, RHO), (hidden, 3.99, [0.9, 0.5, 0.25])):
        aovs = pj.render_aovs(scene, NAMES)
        np.testing.assert_allclose(aovs["depth"], depth, rtol=1e-5)
        np.testing.assert_allclose(aovs["albedo"], np.broadcast_to(albedo, (16, 16, 3)), rtol=1e-5)


def test_chunks_make_no_difference(shipped, monkeypatch):
    from pathjax.rendering import aovs

    scene = shipped("furnace", res=16)
    whole = pj.render_aovs(scene, NAMES)
    monkeypatch.setattr(aovs, "CHUNK_PIXELS", 100)
    for name, image in pj.render_aovs(scene, NAMES).items():
        # Another pixel count is another kernel, which may round differently.
        np.testing.assert_allclose(image, whole[name], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "names, how, says",
    [
        ("depth", {}, r"write \['depth'\]"),
        (["depht"], {}, "depht"),
        (["depth", "normal", "depth"], {}, "depth is named twice"),
        (["depth"], {"spp": 0}, "spp"),
        (["depth"], {"seed": -1}, "seed"),
    ],
)
def test_what_is_refused(make_scene, names, how, says):
    with pytest.raises(pj.InputError, match=says):
        pj.render_aovs(make_scene(""), names, **how)


MITSUBA = """
import sys
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(sys.argv[1], res=24)
aovs = mi.load_dict({"type": "aov", "aovs": "a:depth,b:sh_normal,c:albedo"})
np.save(sys.argv[2], [np.array(mi.render(scene, integrator=aovs, spp=64, seed=seed)) for seed in range(16)])
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_box", "mesh", "glass_and_mirror"])
def test_output_variables_agree_with_mitsuba(root, shipped, agree, estimate_type, tmp_path, name):
    """Mitsuba's albedo includes diffuse reflection only, so it is compared where everything is diffuse."""
    pytest.importorskip("mitsuba")
    file = tmp_path / "aovs.npy"
    subprocess.run([sys.executable, "-c", MITSUBA, root / "scenes" / f"{name}.xml", file], check=True)
    scene = shipped(name, res=24)
    ours = [pj.render_aovs(scene, NAMES, seed=seed) for seed in range(64)]
    ours = np.array([np.concatenate([aovs[name] for name in NAMES], -1) for aovs in ours], float)
    theirs = np.load(file).astype(float)
    channels = 4 if name == "glass_and_mirror" else 7
    # All values are of order 1, and so is their rounding error, even where they are 0: hence the offset.
    both = [1 + x[..., :channels] for x in (ours, theirs)]
    estimates = [estimate_type(x.mean(0), x.var(0, ddof=1) / len(x), len(x)) for x in both]
    agree(*estimates, whole=False, rounding=1e-3)
