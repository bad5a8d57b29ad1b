"""Fields of bsdfs, lights, textures and meshes are parameters in J^T v: against tangents and against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.derivatives import matrix_free
from pathjax.integrators.options import Options
from pathjax.scene import parameters as named
from pathjax.sensors.film import pixel_count

SPP, SEED = 4, 3
# Samples per pixel, many since textured lights reach little of what is seen.
MANY = 64


def place(*steps):
    made = pj.Transform()
    for step, *values in steps:
        made = getattr(made, step)(*values)
    return made


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def picture(*shape, seed=0, high=0.9):
    data = np.random.default_rng(seed).uniform(0.1, high, shape).astype(np.float32)
    return {"type": "bitmap", "raw": True, "data": data}


def scene(dtype=jnp.float32, res=6, depth=4, **things):
    """Return a scene of a camera and these objects."""
    view = {
        "type": "perspective",
        "fov": 50,
        "to_world": place(("look_at", [0, 1.5, 5], [0, 0.5, 0], [0, 1, 0])),
        "film": {"type": "hdrfilm", "width": res, "height": res, "rfilter": {"type": "box"}},
    }
    path = {"type": "path", "max_depth": depth}
    return pj.load_dict({"type": "scene", "integrator": path, "view": view, **things}, dtype=dtype)


def floor(bsdf, y=0.0, half=3.0):
    to_world = place(("translate", [0, y, 0]), ("rotate", [1, 0, 0], -90), ("scale", half))
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def matte(name, *color):
    return {"type": "diffuse", "id": name, "reflectance": rgb(*color)}


def seen_from_both_sides(bsdf):
    return {"type": "twosided", "allow_transmission": True, "inside": bsdf}


def mesh(y=0.0, **carried):
    vertices = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2], [0, 1, 0]], float) + [0, y, 0]
    return {"type": "mesh", "vertices": vertices, "faces": [[0, 2, 1], [0, 3, 2], [0, 1, 4], [3, 0, 4]], **carried}


def attribute(name, **how):
    return {"type": "mesh_attribute", "name": name, **how}


LAMP = {
    "type": "rectangle",
    "to_world": place(("translate", [0, 3, 0]), ("rotate", [1, 0, 0], 90), ("scale", 0.7)),
    "emitter": {"type": "area", "radiance": rgb(5, 4, 3)},
}


def lit_by_pictures():
    from_above = place(("look_at", [1, 3, 1], [0, 0, 0], [0, 1, 0]))
    metal = {"type": "roughconductor", "id": "metal", "alpha": picture(2, 3, high=0.6)}
    return {
        "ground": floor(metal | {"specular_reflectance": picture(2, 2, 3)}),
        "lamp": LAMP | {"emitter": {"type": "area", "radiance": picture(2, 3, 3, high=5)}},
        "spot": {"type": "spot", "texture": picture(2, 2, 3), "cutoff_angle": 30, "to_world": from_above},
        "slides": {"type": "projector", "irradiance": picture(3, 2, 3), "to_world": from_above},
        "sky": {"type": "constant", "radiance": 0.1},
        "dusk": {"type": "constant", "radiance": 0.2},
    }


def mixed():
    inner = {"type": "blendbsdf", "id": "inner", "weight": 0.3, "one": matte("one", 0.2, 0.5, 0.8)}
    inner["other"] = {"type": "roughconductor", "id": "other", "alpha": 0.3}
    outer = {
        "type": "blendbsdf",
        "id": "outer",
        "weight": picture(2, 2),
        "inner": inner,
        "red": matte("red", 0.8, 0.2, 0),
    }
    return {"ground": floor(outer), "lamp": LAMP}


def masked():
    leaf = {"type": "mask", "id": "leaf", "opacity": picture(2, 2), "inside": matte("green", 0.2, 0.6, 0.1)}
    panes = {"type": "blendbsdf", "id": "panes", "weight": 0.35}
    for name, opacity in (("thin", 0.4), ("thick", 0.8)):
        panes[name] = {"type": "mask", "id": name, "opacity": opacity, "inside": matte(f"of_{name}", 0.5, 0.5, 0.5)}
    return {
        "ground": floor(matte("soil", 0.5, 0.6, 0.7)),
        "low": floor(seen_from_both_sides(leaf), 1.0, 2.0),
        "high": floor(seen_from_both_sides(panes), 1.6, 2.0),
        "lamp": LAMP,
    }


def colored():
    random = np.random.default_rng(1)
    metal = {"type": "roughconductor", "id": "metal", "specular_reflectance": attribute("vertex_color", id="shine")}
    faces = {
        "face_color": random.uniform(0.1, 0.5, (4, 3)),
        "bsdf": metal | {"alpha": attribute("face_color", scale=0.5)},
    }
    paint = seen_from_both_sides({"type": "diffuse", "reflectance": attribute("vertex_color", id="paint")})
    return {
        "shell": mesh(vertex_color=random.uniform(0.1, 0.9, (5, 3)), **faces),
        "cover": mesh(1.5, vertex_color=random.uniform(0.1, 0.9, (5, 3)), bsdf=paint),
        "ground": floor({"type": "diffuse", "id": "soil", "reflectance": picture(2, 2, 3)}, -0.2),
        "sky": {"type": "envmap", "data": picture(3, 4, 3)["data"]},
    }


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["mis", "light"])
@pytest.mark.parametrize("things", [lit_by_pictures, mixed, masked, colored], ids=lambda each: each.__name__)
def test_a_sweep_is_the_transpose_of_tangents(x64, things, strategy):
    """For every parameter, along random directions, to the rounding of float64."""
    with x64():
        made = scene(jnp.float64, **things())
        # Also with opacities and weights at their bounds.
        ends = {
            name: x for name, x in (("leaf.opacity", [[0, 1], [1, 0.5]]), ("thick.opacity", 1), ("inner.weight", 0))
        }
        ends = {name: x for name, x in ends.items() if name in pj.parameters(made)}
        for each in [made, pj.with_parameters(made, ends)] if ends else [made]:
            wanted = each.about.parameters
            assert all(matrix_free.is_swept(each, parameter) for parameter in wanted.values())
            pixels, bare, random = jnp.arange(pixel_count(each.film)), named.nameless(each), np.random.default_rng(0)
            work = pixels.astype(jnp.int32), 0, MANY, SEED, Options(strategy)
            v = random.normal(size=(len(pixels), 3))
            pulled, seen = matrix_free.pull(bare, wanted, jnp.asarray(v), *work), 0
            for name, parameter in wanted.items():
                u = jnp.asarray(random.normal(size=parameter.shape))
                terms = np.asarray(matrix_free.push(bare, {name: parameter}, {name: u}, *work)) * v
                assert abs((pulled[name] * u).sum() - terms.sum()) <= 1e-12 * np.abs(terms).sum(), name
                seen += bool(terms.any())
            # Nothing is seen of bsdfs of weight 0, nor on the lamp's back.
            assert seen > len(wanted) / 2


def gradient(made, values):
    """Return the gradient of the image's sum."""
    return jax.grad(lambda values: pj.render(pj.with_parameters(made, values), SPP, SEED).sum())(values)


@pytest.mark.slow
def test_panes_dim_what_is_behind_them():
    """Sunlight passes two panes on its way to the floor, which the camera sees directly: I ~ (1 - a)(1 - b)."""
    panes = [
        floor(
            seen_from_both_sides({"type": "mask", "id": f"pane{k}", "opacity": a, "inside": matte(f"in{k}", 0, 0, 0)}),
            4 + k,
            9,
        )
        for k, a in enumerate((0.3, 1.0))
    ]
    sun = {"type": "directional", "direction": [0, -1, 0]}
    made = scene(depth=4, ground=floor(matte("soil", 0.5, 0.5, 0.5)), low=panes[0], high=panes[1], sun=sun)
    clear = pj.render(pj.with_parameters(made, {"pane0.opacity": 0.0, "pane1.opacity": 0.0}), SPP, SEED).sum()
    found = gradient(made, {name: pj.parameters(made)[name] for name in ("pane0.opacity", "pane1.opacity")})
    np.testing.assert_allclose(
        [found["pane0.opacity"], found["pane1.opacity"]], [0, -0.7 * clear], rtol=1e-5, atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("things", [lit_by_pictures, colored], ids=lambda each: each.__name__)
def test_images_are_linear_in_light(things):
    made = scene(**things())
    lights = [name for name in pj.parameters(made) if name.split(".")[1] in ("radiance", "texture", "irradiance")]
    values = {name: pj.parameters(made)[name] for name in lights}
    found = gradient(made, values)
    total = sum((found[name] * values[name]).sum() for name in lights)
    np.testing.assert_allclose(total, pj.render(made, SPP, SEED).sum(), rtol=1e-5)


def test_what_stands_in_textures_and_meshes_is_listed_set_and_bounded():
    made = scene(**lit_by_pictures())
    shapes = {name: value.shape for name, value in pj.parameters(made).items()}
    assert shapes["metal.alpha"] == (2, 3) and shapes["lamp.radiance"] == (2, 3, 3)
    assert shapes["spot.texture"] == (2, 2, 3) and shapes["slides.irradiance"] == (3, 2, 3)
    new = {
        "metal.alpha": np.float32([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]),
        "lamp.radiance": np.full((2, 3, 3), 7, np.float32),
    }
    changed = pj.with_parameters(made, new)
    for name, value in new.items():
        np.testing.assert_allclose(pj.parameters(changed)[name], value, rtol=1e-6)
    # The mean radiance, by which lights are chosen.
    (area,) = (lights for lights in changed.emitters if lights.lamps is not None)
    np.testing.assert_allclose(area.table.column("radiance").values, [[7, 7, 7]], rtol=1e-6)
    with pytest.raises(pj.InputError, match=r"metal.alpha .* outside its bounds \[0, 1\]"):
        pj.with_parameters(made, {"metal.alpha": 1.5})
    with pytest.raises(pj.InputError, match=r"metal.alpha has the shape \(2, 3\), and cannot be set to 3 x 2"):
        pj.with_parameters(made, {"metal.alpha": np.ones((3, 2))})

    made = scene(**colored())
    shapes = {name: value.shape for name, value in pj.parameters(made).items()}
    assert shapes["shell.vertex_color"] == (5, 3) and shapes["shell.face_color"] == (4, 3)
    assert made.about.parameters["shell.face_color"].bounds == (0, 2)
    colors = np.float32(np.random.default_rng(2).uniform(size=(5, 3)))
    changed = pj.with_parameters(made, {"cover.vertex_color": colors})
    np.testing.assert_array_equal(pj.parameters(changed)["cover.vertex_color"], colors)
    np.testing.assert_array_equal(
        pj.parameters(changed)["shell.vertex_color"], pj.parameters(made)["shell.vertex_color"]
    )


def test_pictures_and_meshes_are_saved(tmp_path):
    for number, things in enumerate((lit_by_pictures, masked, colored)):
        made = scene(**things())
        changed = pj.with_parameters(made, {name: np.float32(0.5 * x) for name, x in pj.parameters(made).items()})
        pj.save_scene(changed, tmp_path / f"{number}.xml")
        again = pj.parameters(pj.load_scene(tmp_path / f"{number}.xml"))
        for name, value in pj.parameters(changed).items():
            np.testing.assert_allclose(again[name], value, rtol=1e-6, err_msg=name)
