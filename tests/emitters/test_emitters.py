"""Light samples integrate to solid angle and irradiance, and a ray that hits the light gets the same density."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy import stats

from pathjax import description as desc
from pathjax import emitters
from pathjax.bsdfs import Diffuse
from pathjax.core.types import Ray
from pathjax.emitters import Area, Constant
from pathjax.errors import InputError
from pathjax.scene import build
from pathjax.scene.parameters import with_parameters
from pathjax.sensors import Perspective
from pathjax.sensors.film import HDRFilm
from pathjax.shapes import Cube, Disk, Mesh, Rectangle, Sphere, geometry

# Chance that a correct light fails one statistical comparison; seeds are fixed.
FALSE_ALARM = 1e-5
N = 60_000
# Relative error of float32 in a density at oblique angles.
ROUNDING = 2e-5
RADIANCE = np.array([3.0, 2.0, 1.0])
GREY = Diffuse.instance("grey")
choice_of = jax.jit(emitters.choice, static_argnums=1)  # jitted as in kernels; one program


def affine(linear, translation):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = linear, translation
    return m


ROTATION = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]
ROTATION *= np.sign(np.linalg.det(ROTATION))
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
PLACED = affine(ROTATION * [0.5, 0.3, 1], [0.2, 0.1, 0.3])
SHEARED = affine(ROTATION @ [[0.6, 0.4, 0], [0, 0.5, 0], [0, 0.2, 1.0]], [0.2, 0.1, 0.3])
BALL = Sphere(np.array([0.2, 0.1, 0.3]), 0.5, affine(0.5 * np.eye(3), [0.2, 0.1, 0.3]))
CENTER = np.array([0.2, 0.1, 0.3])


def convex_mesh(scale=0.5, subdivisions=1):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = ball.vertices * [scale, 0.7 * scale, 1.2 * scale] @ ROTATION.T + CENTER
    return Mesh(vertices, np.asarray(ball.faces), None, None)


def shape(geo, radiance=RADIANCE, flip=False, name="light"):
    return desc.Shape(name, geo, GREY, Area.instance(f"{name}.emitter", radiance=radiance), flip)


def scene_of(*shapes, background=None, dtype=jnp.float32):
    camera, film = Perspective(np.eye(4), 45.0), HDRFilm(2, 2)
    skies = () if background is None else (Constant.instance("sky", radiance=background),)
    about = desc.Description("test", desc.View(camera, film, 1, "independent"), desc.Integrator(), shapes, skies)
    return build(about, dtype)


def carried(points, m):
    return points @ m[:3, :3].T + m[:3, 3]


def polygons_of(geo):
    """Return flat outlines (K, 3), counter-clockwise seen from the front."""
    match geo:
        case Rectangle(m):
            return [carried(SQUARE, m)]
        case Disk(m):
            a = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
            return [carried(np.stack([np.cos(a), np.sin(a), 0 * a], -1), m)]
        case Cube(m):
            faces = []
            for axis in range(3):
                for side in (-1, 1):
                    face = np.roll(SQUARE + [0, 0, 1], axis + 1, axis=1) * side
                    faces.append(carried(face[::side], m))
            return faces
        case Mesh(vertices, triangles):
            return list(vertices[triangles])


def solid_angle_and_irradiance(outline, ref, normal):
    """For the front of a polygon above the horizon (Van Oosterom and Strackee 1983; Lambert 1760)."""
    front = np.cross(outline[1] - outline[0], outline[2] - outline[0])
    if np.dot(front, ref - outline[0]) <= 0:
        return 0.0, 0.0
    r = outline - ref
    r = r / np.linalg.norm(r, axis=1, keepdims=True)
    a, b, c = r[0], r[1:-1], r[2:]
    triple = np.sum(a * np.cross(b, c), -1)
    omega = 2 * np.arctan2(triple, 1 + b @ a + np.sum(b * c, -1) + c @ a).sum()
    following = np.roll(r, -1, axis=0)
    axes = np.cross(r, following)
    length = np.linalg.norm(axes, axis=1)
    theta = np.arctan2(length, np.sum(r * following, 1))
    return abs(omega), abs(np.sum(theta * (axes @ normal) / length)) / 2


def exact(geo, ref, normal):
    if isinstance(geo, Sphere):
        distance = np.linalg.norm(geo.center - ref)
        if distance < geo.radius:
            return 4 * np.pi, np.pi
        sin2 = (geo.radius / distance) ** 2
        return 2 * np.pi * (1 - np.sqrt(1 - sin2)), np.pi * sin2
    return tuple(np.sum([solid_angle_and_irradiance(p, ref, normal) for p in polygons_of(geo)], 0))


def uniform(n, seed):
    u = np.random.default_rng(seed).integers(0, 1 << 24, (n, 3)) * 2.0**-24
    return jnp.asarray(u[:, :2], jnp.float32), jnp.asarray(u[:, 2], jnp.float32)


@jax.jit
def _sample_and_trace(scene, choice, refs, u, u_part):
    def one(ref, u, u_part):
        shapes, lights = scene.geometry, scene.emitters
        drawn = emitters.sample(lights, shapes, choice, ref, u, u_part)
        ray = Ray(ref, drawn.d, jnp.full_like(ref[0], jnp.inf), jnp.int32(-1))
        if not shapes.tables:
            return drawn, None, *emitters.background(lights, choice, drawn.d)
        hit = geometry.closest_hit(shapes, ray)
        surface = geometry.surface(shapes, ray, hit)
        return drawn, (hit, surface), *emitters.hit(lights, shapes, choice, ray, hit, surface)

    return jax.vmap(one)(refs, u, u_part)


@jax.jit
def _sample(scene, choice, refs, u, u_part):
    def one(ref, u, u_part):
        return emitters.sample(scene.emitters, scene.geometry, choice, ref, u, u_part)

    return jax.vmap(one)(refs, u, u_part)


def sampled_primitives(scene, ref, strategy="mis"):
    """Return the primitives of N light samples from one point."""
    refs = jnp.broadcast_to(jnp.asarray(ref, jnp.float32), (N, 3))
    choice = choice_of(scene.emitters, strategy)
    return np.asarray(_sample(replace(scene, about=None), choice, refs, *uniform(N, 1)).primitive)


def sample_and_trace(scene, refs, strategy="mis"):
    """Return N light samples, in blocks for each of `refs` (K, 3), and what a ray along each sample hits."""
    refs = jnp.asarray(np.repeat(refs, N // len(refs), 0), jnp.float32)
    choice = choice_of(scene.emitters, strategy)
    # Without names, scenes of one structure share a kernel, which saves most of the time of these tests.
    out = _sample_and_trace(replace(scene, about=None), choice, refs, *uniform(len(refs), 1))
    return jax.tree.map(lambda x: np.asarray(x, np.float64) if x.dtype == jnp.float32 else np.asarray(x), out)


OUTSIDE = [CENTER + 1.7 * np.array(v) for v in ([0.6, 0.0, 0.8], [-0.48, 0.6, -0.64], [0.0, -0.8, 0.6])]
FRONT = [CENTER + ROTATION @ v for v in ([0, 0, 1.0], [0.5, 0.2, 0.9], [1.0, -0.8, 0.9])]
LIGHTS = {
    "rectangle": (Rectangle(PLACED), False, FRONT),
    "sheared": (Rectangle(SHEARED), False, FRONT),
    "disk": (Disk(PLACED), False, FRONT),
    "sphere": (BALL, False, [*OUTSIDE, CENTER + [0, 0, 0.51], CENTER + [40, 0, 0]]),
    "inside": (BALL, True, [CENTER, CENTER + [0.2, 0.1, -0.3]]),
    "cube": (Cube(affine(ROTATION * [0.4, 0.3, 0.5], CENTER)), False, OUTSIDE),
    "mesh": (convex_mesh(), False, OUTSIDE),
}


@pytest.mark.parametrize("kind", LIGHTS)
def test_samples_integrate_and_rays_agree(kind):
    geo, flip, refs = LIGHTS[kind]
    scene = scene_of(shape(geo, flip=flip))
    each = N // len(refs)
    drawn, (hit, surface), Le, pdf = sample_and_trace(scene, refs)

    for ref, part in zip(refs, range(0, len(drawn.pdf), each), strict=False):
        ref = np.float64(np.float32(ref))
        normal = (CENTER - ref) / max(np.linalg.norm(CENTER - ref), 1e-9)
        if kind == "inside":
            normal = np.array([0, 0, 1.0])
        s = slice(part, part + each)
        found = drawn.pdf[s] > 0
        one_over = np.where(found, 1 / np.where(found, drawn.pdf[s], 1), 0)
        cos = np.maximum(drawn.d[s] @ normal, 0)
        for values, truth in zip((one_over, one_over * cos), exact(geo, ref, normal), strict=True):
            error = values.std() / np.sqrt(each) + ROUNDING * truth
            assert 2 * stats.norm.sf(abs(values.mean() - truth) / error) > FALSE_ALARM, (ref, values.mean(), truth)

    # A ray along the sample hits the same light, except that samples on the last ulps of a rim may miss it.
    ok = drawn.pdf > 0
    same = ok & (hit.primitive == drawn.primitive)
    assert (ok & ~same).sum() <= 1e-4 * ok.sum()
    cos = np.abs(np.sum(surface.n * drawn.d, 1))
    clear = same & (cos > 0.01)
    np.testing.assert_allclose(pdf[clear], drawn.pdf[clear], rtol=1e-4)
    np.testing.assert_allclose(hit.t[clear], drawn.distance[clear], rtol=1e-5 if kind != "sphere" else 1e-3)
    np.testing.assert_array_equal(Le[same], drawn.Le[same])
    np.testing.assert_array_equal(Le[same], np.broadcast_to(RADIANCE, Le[same].shape))


def test_constant_background_integrates_over_the_sphere():
    scene = scene_of(background=RADIANCE)
    drawn, _, Le, pdf = sample_and_trace(scene, [[0, 0, 0]], strategy="light")
    np.testing.assert_allclose(drawn.pdf, 1 / (4 * np.pi), rtol=1e-6)
    np.testing.assert_allclose(pdf, drawn.pdf, rtol=1e-6)
    assert np.isinf(drawn.distance).all() and (drawn.primitive == -1).all()
    np.testing.assert_array_equal(Le, np.broadcast_to(RADIANCE, Le.shape))
    values = np.maximum(drawn.d[:, 2], 0) / drawn.pdf
    assert 2 * stats.norm.sf(abs(values.mean() - np.pi) / (values.std() / np.sqrt(N))) > FALSE_ALARM
    assert emitters.choice(scene.emitters, "mis") is None


@pytest.mark.parametrize("kind", ["rectangle", "disk", "mesh"])
def test_lights_are_dark_behind(kind):
    geo = Mesh(carried(SQUARE, PLACED), np.array([[0, 1, 2], [0, 2, 3]]), None, None)
    geo = {"rectangle": Rectangle(PLACED), "disk": Disk(PLACED), "mesh": geo}[kind]
    behind = CENTER + ROTATION @ [0.1, 0.2, -0.8]
    for flip in (False, True):
        drawn, (hit, _), Le, pdf = sample_and_trace(scene_of(shape(geo, flip=flip)), [behind])
        assert (hit.primitive >= 0).all()
        assert (drawn.pdf > 0).all() == flip and (drawn.Le > 0).all() == flip and (Le > 0).all() == flip
        assert (drawn.pdf > 0).any() == flip and (drawn.Le > 0).any() == flip and (Le > 0).any() == flip


FLAT = affine(np.eye(3), [0.0, 0.0, 0.0])
HARD = {
    "edge-on rectangle": (Rectangle(FLAT), [[3, 0.1, 0], [0, -2, 0], [1, 0, 0], [3, 0.1, 1e-7], [3, 0, -1e-30]]),
    "edge-on disk": (Disk(FLAT), [[3, 0.1, 0], [0, -2, 0], [1, 0, 0], [3, 0.1, 1e-7]]),
    "edge-on mesh": (Mesh(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), None, None), [[3, 0.1, 0], [-1, -1, 0]]),
    "on the rectangle": (Rectangle(FLAT), [[0, 0, 0], [0.25, -0.5, 0], [1, 1, 0]]),
    "on the tilted rectangle": (Rectangle(PLACED), [CENTER, carried(np.array([0.5, 0.5, 0]), PLACED)]),
    "on the sphere": (BALL, [CENTER + [0, 0, 0.5], CENTER + [0.3, 0, -0.4], CENTER, CENTER + [0, 0.50000006, 0]]),
    "on the cube": (Cube(FLAT), [[1, 1, 1], [1, 0, 0], [0, 0, 0], [1, 1, 0.5]]),
    "far away": (BALL, [CENTER + [1e6, 0, 0], CENTER + [0, 1e12, 0]]),
    "of no area": (Rectangle(affine(1e-24 * np.eye(3), CENTER)), [[0, 0, 0], CENTER]),
    "tiny": (Sphere(CENTER, 1e-6, FLAT), [[0, 0, 0], [1, 1, 1]]),
}


@pytest.mark.parametrize("case", HARD)
def test_hard_positions_give_no_nan(case):
    geo, refs = HARD[case]
    for flip in (False, True):
        scene = scene_of(shape(geo, flip=flip))
        drawn, (hit, surface), Le, pdf = sample_and_trace(scene, refs)
        for x in (drawn.d, drawn.distance, drawn.Le, drawn.pdf):
            assert np.isfinite(x).all()
        found = hit.primitive >= 0
        assert np.isfinite(Le[found]).all() and np.isfinite(pdf[found]).all()
        assert (drawn.pdf >= 0).all() and (pdf[found] >= 0).all()
        length = np.linalg.norm(drawn.d, axis=1)
        np.testing.assert_allclose(length[drawn.pdf > 0], 1, atol=1e-5)


def test_distant_sphere_keeps_its_solid_angle():
    """In float32, 1 - cos of a half angle of 1e-5 has no correct digit."""
    ref = CENTER + [0.5e5, 0, 0]
    drawn, _, _, _ = sample_and_trace(scene_of(shape(BALL)), [ref])
    np.testing.assert_allclose(1 / drawn.pdf, np.pi * 1e-10, rtol=1e-3)


def test_a_light_of_no_power_is_harmless():
    scene = scene_of(shape(Rectangle(PLACED), radiance=np.zeros(3)), shape(BALL, radiance=np.zeros(3), name="b"))
    choice = choice_of(scene.emitters, "mis")
    np.testing.assert_allclose(choice.pdf, 0.5)
    drawn, _, Le, pdf = sample_and_trace(scene, FRONT)
    assert np.isfinite(drawn.pdf).all() and not drawn.Le.any() and np.isfinite(pdf).all()


def test_a_dark_light_beside_a_bright_one_is_never_chosen():
    scene = scene_of(shape(Rectangle(PLACED), radiance=np.zeros(3)), shape(BALL, name="b"))
    drawn, *_ = sample_and_trace(scene, OUTSIDE)
    assert (drawn.primitive == 0).all() and (drawn.pdf > 0).all()  # the sphere is primitive 0


@pytest.mark.parametrize("strategy", ["mis", "light"])
def test_lights_are_chosen_by_power(strategy):
    shapes = [
        shape(Rectangle(PLACED), np.array([1.0, 5.0, 2.0])),
        shape(BALL, np.array([0.2, 0.1, 0.3]), name="ball"),
        shape(convex_mesh(), np.array([0.5, 0.5, 0.1]), name="mesh"),
        shape(Disk(SHEARED), np.array([0.01, 0.02, 0.03]), name="disk"),
    ]
    scene = scene_of(*shapes, background=np.ones(3))
    choice = choice_of(scene.emitters, strategy)
    areas = [4 * 0.15, np.pi, trimesh.Trimesh(*mesh_arrays(shapes[2].geometry)).area]
    sheared = np.cross(*SHEARED[:3, :2].T)
    areas.append(np.pi * np.linalg.norm(sheared))
    radiances = [s.emitter.values["radiance"] for s in shapes]
    power = np.array([a * radiance @ [0.2126, 0.7152, 0.0722] for a, radiance in zip(areas, radiances, strict=True)])
    probability = power / power.sum()
    if strategy == "light":
        probability = np.append(probability, 1) / 2
    np.testing.assert_allclose(choice.pdf, probability, rtol=1e-5)
    assert np.sum(np.asarray(choice.pdf), dtype=np.float64) == pytest.approx(1, abs=1e-6)
    assert choice.cdf[-1] == pytest.approx(1, abs=1e-6)

    primitive = sampled_primitives(scene, CENTER + [0, 0, 3], strategy)
    # Primitives are the sphere, the rectangle, the disk and the triangles, in this order; the background is -1.
    light = np.select([primitive == 0, primitive == 1, primitive == 2, primitive > 2], [1, 0, 3, 2], 4)
    counts = np.bincount(light, minlength=len(probability))
    assert stats.chisquare(counts, probability * N).pvalue > FALSE_ALARM


def mesh_arrays(mesh):
    return mesh.vertices, mesh.faces


def test_triangles_of_a_mesh_are_chosen_by_area():
    mesh = convex_mesh()
    primitive = sampled_primitives(scene_of(shape(mesh)), CENTER)
    areas = trimesh.Trimesh(*mesh_arrays(mesh), process=False).area_faces
    counts = np.bincount(primitive, minlength=len(areas))
    assert stats.chisquare(counts, areas / areas.sum() * counts.sum()).pvalue > FALSE_ALARM


def test_a_small_mesh_beside_a_large_one_is_sampled_all_over():
    """The lamp has 1e-4 of the size of the window, and the cumulative area of both must keep the lamp's digits."""
    large, small = convex_mesh(100.0), convex_mesh(0.01)
    window = Mesh(large.vertices + [0, 0, 1000], large.faces, None, None)
    scene = scene_of(shape(window), shape(small, RADIANCE * 1e8, name="lamp"))
    count = len(small.faces)
    counts = np.bincount(sampled_primitives(scene, CENTER), minlength=2 * count)[count:]
    areas = trimesh.Trimesh(*mesh_arrays(small), process=False).area_faces
    assert counts.sum() > 10_000
    assert stats.chisquare(counts, areas / areas.sum() * counts.sum()).pvalue > FALSE_ALARM


def test_derivatives_of_the_choice_are_zero():
    """The choice of a light is not differentiated; its radiance is."""
    scene = scene_of(shape(Rectangle(PLACED)), shape(BALL, name="ball"))
    def pdf(scale):
        changed = with_parameters(scene, {"light.emitter.radiance": RADIANCE * scale})
        return emitters.choice(changed.emitters, "mis").pdf

    np.testing.assert_array_equal(jax.jit(jax.jacfwd(pdf))(1.0), np.zeros(2))


def test_lights_are_sampled_by_their_weights(make_scene):
    """For equal lamps; strategy "light" ignores weights, since it must also find lamps of weight 0."""
    lamp = """<shape type="rectangle"><transform name="to_world"><translate x="{}"/></transform>
      <emitter type="area">{}</emitter></shape>"""
    weight = '<float name="sampling_weight" value="{}"/>'
    scene = make_scene(lamp.format(0, weight.format(3)) + lamp.format(3, "") + lamp.format(6, weight.format(0)))
    np.testing.assert_allclose(choice_of(scene.emitters, "mis").pdf, [3 / 4, 1 / 4, 0], rtol=1e-6)
    np.testing.assert_allclose(choice_of(scene.emitters, "light").pdf, [1 / 3] * 3, rtol=1e-6)
    plain = make_scene(lamp.format(0, "") + lamp.format(3, ""))
    assert plain.emitters[0].table.column("sampling_weight") is None
    for kind in ("point", "spot", "projector", "directional"):
        light = f'<emitter type="{kind}">{{}}</emitter>'
        assert make_scene(light.format(weight.format(2))).emitters[0].power(weighted=True).shape == (1,)
        with pytest.raises(InputError, match="at least 1.17"):
            make_scene(light.format(weight.format(0)))
