"""The transport operator, its solvers, and its images through the camera."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import pathjax as pj
from pathjax import transport
from pathjax.compile import native
from pathjax.transport import factors, rays, view

RHO = np.array([0.2, 0.5, 0.8])
FACES = {  # of the cube [-1, 1]^3, looking inwards: rotation that carries z to the normal
    (0, 0, -1): "",
    (0, 0, 1): '<rotate x="1" angle="180"/>',
    (-1, 0, 0): '<rotate y="1" angle="90"/>',
    (1, 0, 0): '<rotate y="1" angle="-90"/>',
    (0, -1, 0): '<rotate x="1" angle="-90"/>',
    (0, 1, 0): '<rotate x="1" angle="90"/>',
}


def rgb(values):
    return ", ".join(f"{v:.9g}" for v in np.broadcast_to(values, 3))


def square(center, rotation, reflectance, radiance=None, name="wall"):
    lamp = ""
    if radiance is not None:
        lamp = f'<emitter type="area" id="{name}-glow"><rgb name="radiance" value="{rgb(radiance)}"/></emitter>'
    return (
        f'<shape type="rectangle"><transform name="to_world">{rotation}<translate x="{center[0]}" y="{center[1]}" '
        f'z="{center[2]}"/></transform><bsdf type="diffuse" id="{name}"><rgb name="reflectance" '
        f'value="{rgb(reflectance)}"/></bsdf>{lamp}</shape>'
    )


def box(albedo, radiance=None):
    """Return a closed cube whose pairs of faces across z, x, y have albedo[0], [1], [2], and likewise radiances."""
    faces = zip(FACES.items(), np.repeat(range(3), 2), "abcdef", strict=True)
    return "".join(
        square(at, turn, albedo[k], None if radiance is None else radiance[k], name) for (at, turn), k, name in faces
    )


def plates(gap=2, emission=(1, None), reflectance=RHO):
    upper = square((0, 0, gap), FACES[0, 0, 1], reflectance, emission[1], "upper")
    return square((0, 0, 0), "", reflectance, emission[0], "lower") + upper


def primitive_of(op):
    return np.asarray(op.patches.primitive)[np.asarray(op.patches.cell)]


def centers(op, scene):
    """Return the centres (U, 3) of patches of rectangles."""
    (table,) = scene.geometry.tables
    c, a, b, _ = np.moveaxis(np.asarray(table.frames, float)[primitive_of(op)], 1, 0)
    cell = np.asarray(op.patches.cell)
    grid, place = np.asarray(op.patches.grid)[primitive_of(op)], np.asarray(op.patches.place)[cell]
    x, y = (2 * (place + 0.5) / grid - 1).T
    return c + x[:, None] * a + y[:, None] * b


# ---- closed forms ---------------------------------------------------------------------------------------------------


def test_terms_in_a_closed_sphere_are_powers_of_the_albedo(shipped):
    op = transport.operator(shipped("furnace", shape="sphere", res=16), 200)
    terms = np.asarray(op.terms(6))
    powers = RHO ** np.arange(6)[:, None]
    np.testing.assert_allclose(terms, np.broadcast_to(powers[:, None], terms.shape), rtol=1e-5)
    np.testing.assert_allclose(op.solve().L, np.broadcast_to(1 / (1 - RHO), op.Le.shape), rtol=1e-5)
    np.testing.assert_allclose(op.spectral_radius(), RHO, rtol=1e-5)


def test_indirect_light_in_a_sphere_is_uniform_whatever_emits(shipped):
    """Bounce k is rho^k times the mean emission."""
    op = transport.operator(shipped("furnace", shape="sphere", res=16), 200)
    Le = np.random.default_rng(1).uniform(size=op.Le.shape).astype(np.float32)
    op = transport.Operator(op.patches, op.factors, op.albedo, jnp.asarray(Le))
    mean = np.average(Le, axis=0, weights=op.area)
    for k, term in enumerate(np.asarray(op.terms(4))[1:], 1):
        np.testing.assert_allclose(term, np.broadcast_to(mean * RHO**k, term.shape), rtol=1e-5)
    np.testing.assert_allclose(op.solve().L - Le, np.broadcast_to(mean * RHO / (1 - RHO), Le.shape), rtol=2e-5)


def test_spherical_cavity_with_a_lamp_by_ray_casting(make_scene):
    """A disk spans a cap of a sphere and emits like it: the wall that sees it receives Le times the cap's fraction f.

    The cap is two of nine belts of the sphere, so light is uniform on each patch and only the rays err.
    """
    f, radiance = 2 / 9, 3
    z = 1 - 2 * f
    scene = make_scene(
        '<shape type="sphere"><boolean name="flip_normals" value="true"/><bsdf type="diffuse">'
        f'<rgb name="reflectance" value="{rgb(RHO)}"/></bsdf></shape>'
        f'<shape type="disk"><transform name="to_world"><scale value="{np.sqrt(1 - z * z)}"/>'
        f'<translate z="{-z}"/></transform><emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>'
    )
    op = transport.operator(scene, 300, rays=1024)
    assert op.patches.grid[0, 1] == 9
    belt = np.asarray(op.patches.place)[np.asarray(op.patches.cell), 1]
    wall = (primitive_of(op) == 0) & (belt < 7)
    assert not np.asarray(op.terms(2))[1, ~wall].any()
    area = np.asarray(op.area)[wall]
    for k, term in enumerate(np.asarray(op.terms(4))[1:, wall], 1):
        expected = radiance * RHO**k * f * (1 - f) ** (k - 1)
        np.testing.assert_allclose(np.average(term, axis=0, weights=area), expected, rtol=2e-3)
        if k == 1:
            score = (term - expected) / np.asarray(op.error(op.Le))[wall]
            assert np.abs(score).max() < -stats.norm.ppf(1e-4 / score.size / 2)
            assert np.mean(score**2) < 1.1


def test_cube_of_three_albedos_that_emits_what_it_absorbs(make_scene):
    """Le = 1 - rho on each face: L = 1 everywhere."""
    albedo = np.array([[0.2, 0.5, 0.8], [0.5, 0.8, 0.2], [0.8, 0.2, 0.5]])
    op = transport.operator(make_scene(box(albedo, 1 - albedo)), 96)
    for solution in (op.solve(), op.solve("neumann")):
        np.testing.assert_allclose(solution.L, 1, rtol=1e-5)
        assert solution.residual < 1e-5


def corner(a, b):
    """Return the share of a point's light on a parallel rectangle a x b at distance 1, a corner above the point."""
    ra, rb = np.hypot(1, a), np.hypot(1, b)
    return (a / ra * np.arctan(b / ra) + b / rb * np.arctan(a / rb)) / (2 * np.pi)


def upright(along, height, away):
    """Return that on an upright rectangle at distance `away` that extends from its foot by `along` x `height`."""
    d = np.hypot(height, away)
    return (np.arctan2(along, away) - away / d * np.arctan2(along, d)) / (2 * np.pi)


def shares_of_faces(x, face):
    """Return shares (6, N) of the light of points x (N, 3) on a face of the cube that each face gets; closed forms."""
    axis = np.flatnonzero(face)[0]
    others = [i for i in range(3) if i != axis]
    result = []
    for target in FACES:
        k = np.flatnonzero(target)[0]
        if k == axis:
            terms = [
                corner((1 + s * x[:, others[0]]) / 2, (1 + t * x[:, others[1]]) / 2) for s in (-1, 1) for t in (-1, 1)
            ]
            result.append(sum(terms) * (target != face))
        else:
            (other,) = (i for i in others if i != k)
            away = 1 - target[k] * x[:, k]
            result.append(sum(upright(1 + s * x[:, other], 2.0, away) for s in (-1, 1)))
    return np.stack(result)


@pytest.mark.parametrize("sides", [(2, 4, 8), pytest.param((4, 8, 16), marks=pytest.mark.slow)])
def test_cube_of_three_albedos_converges_by_the_square_of_the_patches(make_scene, sides):
    """L = 1, 2, 3 on its pairs of faces is the solution for Le = L - rho E, E the irradiance over pi: a closed form, as
    each face is uniform. With Le taken at the centres of the patches, the mean of L over each face errs by O(h^2).
    """
    albedo, L = np.array([0.3, 0.5, 0.7]), np.repeat([1.0, 2.0, 3.0], 2)
    scene = make_scene(box(albedo))
    errors = []
    for side in sides:
        op = transport.operator(scene, 6 * side**2, method="dense")
        x, primitive, Le = centers(op, scene), primitive_of(op), np.zeros(op.patches.count)
        for number, face in enumerate(FACES):
            on = primitive == number
            shares = shares_of_faces(x[on], face)
            np.testing.assert_allclose(shares.sum(0), 1, rtol=1e-6)
            Le[on] = L[number] - albedo[number // 2] * (L @ shares)
        op = transport.Operator(op.patches, op.factors, op.albedo, jnp.asarray(Le[:, None].repeat(3, 1), op.Le.dtype))
        of_faces = np.array([np.asarray(op.solve().L)[primitive == k, 0].mean() for k in range(6)])
        errors.append(np.abs(of_faces / L - 1).max())
    orders = np.log2(errors[:-1] / np.array(errors[1:]))
    assert (orders > 1.8).all(), errors
    assert errors[-1] < 4e-4 * (8 / sides[-1]) ** 2


def test_facing_plates_converge_by_the_square_of_the_patches(make_scene):
    """The light of a glowing plate at each point of the other has a closed form, and the patches' means differ from
    the values at their centres by O(h^2).
    """
    gap, sides = 8, (4, 8, 16)
    scene = make_scene(plates(gap))
    errors = []
    for side in sides:
        op = transport.operator(scene, 2 * side**2, method="dense")
        x, upper = centers(op, scene), primitive_of(op) == 1
        x = x[upper, :2] / gap
        exact = sum(corner(1 / gap + s * x[:, 0], 1 / gap + t * x[:, 1]) for s in (-1, 1) for t in (-1, 1))
        first = np.asarray(op.terms(2))[1, upper]
        errors.append(np.abs(first / (exact[:, None] * RHO) - 1).max())
    orders = np.log(errors[:-1] / np.array(errors[1:])) / np.log(np.array(sides[1:]) / sides[:-1])
    assert (np.abs(orders - 2) < 0.1).all(), (errors, orders)
    assert errors[-1] < 1e-4


# ---- algebra --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["dense", "rays"])
def cornell(request, empty_cornell):
    scene = empty_cornell(res=16)
    return scene, transport.operator(scene, 200, method=request.param, rays=64)


def inner(op, f, g):
    return (np.asarray(op.area, float)[:, None] * np.asarray(f, float) * np.asarray(g, float)).sum()


def test_reciprocity_and_adjoint_hold_to_rounding(cornell):
    _, op = cornell
    exchange = np.asarray(op.area)[:, None] * np.asarray(op.F.as_matrix())
    np.testing.assert_allclose(exchange, exchange.T, rtol=1e-6)
    f, g = np.random.default_rng(1).uniform(size=(2, *op.Le.shape)).astype(np.float32)
    assert inner(op, op.T.mv(f), g) == pytest.approx(inner(op, f, op.adjoint.mv(g)), rel=1e-6)
    # lineax's transpose of T is for the plain sum over patches.
    assert np.vdot(op.T.mv(f), g) == pytest.approx(np.vdot(f, op.T.transpose().mv(g)), rel=1e-6)


def test_gmres_and_the_neumann_series_agree(cornell):
    _, op = cornell
    solution = op.solve()
    np.testing.assert_allclose(op.solve("neumann").L, solution.L, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(op.solve("neumann", depth=3).L, op.terms(3).sum(0), rtol=1e-6)
    np.testing.assert_array_equal(op.solve("neumann", depth=1).L, op.Le)
    assert solution.residual < 1e-6


def test_residuals_fall_fastest_by_gmres(cornell):
    _, op = cornell
    least, neumann = (op.residual_history(12, method) for method in ("gmres", "neumann"))
    assert least[0] == neumann[0] == 1
    assert (np.diff(least) < 0).all()
    assert (least <= neumann * 1.001).all()
    assert least[-1] < neumann[-1] / 10
    # In the end each bounce of the series multiplies the residual by the spectral radius.
    assert neumann[-1] / neumann[-2] == pytest.approx(float(op.spectral_radius().max()), rel=0.03)


def test_spectral_radius_is_the_largest_eigenvalue(cornell):
    _, op = cornell
    # They are those of a symmetric matrix, since area times factors is symmetric.
    exchange = np.asarray(op.area, float)[:, None] * np.asarray(op.F.as_matrix(), float)
    np.testing.assert_allclose(exchange, exchange.T, rtol=1e-4, atol=1e-6 * exchange.max())
    roots = np.sqrt(np.asarray(op.albedo, float) / np.asarray(op.area, float)[:, None]).T
    largest = [np.abs(np.linalg.eigvalsh(root[:, None] * exchange * root)).max() for root in roots]
    np.testing.assert_allclose(op.spectral_radius(), largest, rtol=1e-4)


def test_spectral_radius_of_plates_that_see_but_each_other(make_scene):
    """-radius is an eigenvalue too. With one patch each, the radius is the form factor times the albedo."""
    op = transport.operator(make_scene(plates()), 2)
    np.testing.assert_allclose(op.spectral_radius(), op.factors.matrix[0, 1] * RHO, rtol=1e-5)


def test_float64(empty_cornell, x64):
    with x64():
        scene = empty_cornell(jnp.float64, res=16)
        for method in transport.METHODS:
            op = transport.operator(scene, 20, method=method, rays=64)
            exchange = np.asarray(op.area)[:, None] * np.asarray(op.F.as_matrix())
            np.testing.assert_allclose(exchange, exchange.T, rtol=1e-14)
        solution = op.solve()
        assert solution.L.dtype == jnp.float64
        assert solution.residual < 1e-14


def test_a_dark_scene_stays_dark(make_scene):
    solution = transport.operator(make_scene(plates(emission=(None, None))), 8).solve()
    assert not np.asarray(solution.L).any() and solution.residual == 0


# ---- derivatives ----------------------------------------------------------------------------------------------------


def test_derivatives_in_a_furnace_are_closed_forms(shipped):
    """L = Le / (1 - rho), so dL/drho = Le / (1 - rho)^2; for bounce k it is k rho^(k-1)."""
    scene = shipped("furnace", res=16)
    op = transport.operator(scene, 24)

    def light(rho, **how):
        there = op.with_scene(pj.with_parameters(scene, {"wall.reflectance": rho}))
        return there.solve(**how).L[0]

    rho = jnp.asarray(RHO, jnp.float32)
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(jacobian(light))(rho), np.diag(1 / (1 - RHO) ** 2), rtol=1e-4, atol=1e-4)
    slopes = jax.jit(jax.jacrev(lambda rho: light(rho, method="neumann", depth=3)))(rho)
    np.testing.assert_allclose(slopes, np.diag(1 + 2 * RHO), rtol=1e-5)


@pytest.mark.slow
def test_derivatives_of_an_image_are_differences(empty_cornell, x64):
    with x64():
        scene = empty_cornell(jnp.float64, res=8)
        op = transport.operator(scene, 60)
        white = pj.parameters(scene)["white.reflectance"]

        def brightness(rho):
            there = op.with_scene(pj.with_parameters(scene, {"white.reflectance": rho}))
            return jnp.mean(transport.image(scene, op.radiosity(there.solve().L), spp=2) ** 2)

        both = jax.jit(jax.value_and_grad(brightness))
        _, slope = both(white)
        step = 1e-5
        steps = [both(white + step * unit)[0] - both(white - step * unit)[0] for unit in np.eye(3)]
        np.testing.assert_allclose(slope, np.array(steps) / (2 * step), rtol=1e-7)


# ---- through the camera ---------------------------------------------------------------------------------------------


def test_image_of_a_furnace(shipped):
    scene = shipped("furnace", res=16)
    op = transport.operator(scene, 24)
    image = transport.image(scene, op.radiosity(op.solve().L), spp=1)
    np.testing.assert_allclose(image, np.broadcast_to(1 / (1 - RHO), image.shape), rtol=1e-5)


def test_image_shows_backs_and_misses_black(make_scene):
    scene = make_scene(square((0, 0, 0), FACES[0, 0, 1], 0.5, 1), fov=60)
    op = transport.operator(scene, 4)
    assert not np.asarray(transport.image(scene, op.radiosity(op.solve().L))).any()


def against_renders(scene, operators, truncated=None, seeds=8, spp=256):
    """Return the relative RMS, over pixels, of the difference of each operator and the path tracer with the same camera
    rays; that of the standard error of the last one's difference; and the mean images of the operators.

    truncated: a number of bounces, to compare the terms of just that number; None: compare all light.
    """

    def render(depth, seed):
        return np.asarray(pj.render(replace(scene, max_depth=jnp.int32(depth)), spp, seed), float)

    if truncated is None:
        traced = np.array([render(1 << 30, seed) for seed in range(seeds)])
    else:
        traced = np.array([render(truncated + 1, seed) - render(truncated, seed) for seed in range(seeds)])
    lights = [op.solve().L if truncated is None else op.terms(truncated + 1)[-1] for op in operators]
    images = np.array(
        [
            [transport.image(scene, op.radiosity(L), spp, seed) for seed in range(seeds)]
            for op, L in zip(operators, lights, strict=True)
        ],
        float,
    )
    scale = np.sqrt((traced.mean(0) ** 2).mean())
    differences = images - traced
    noise = np.sqrt((differences[-1].var(0, ddof=1) / seeds).mean()) / scale
    errors = np.sqrt((differences.mean(1) ** 2).mean((1, 2, 3))) / scale
    return errors, noise, images.mean(1)


@pytest.fixture(scope="module")
def refined(empty_cornell):
    scene = empty_cornell(res=32, max_depth=-1)
    return scene, [transport.operator(scene, count, method="dense") for count in (100, 400, 1600)]


@pytest.mark.slow
def test_operator_against_the_path_tracer(refined):
    """The bias falls with refinement down to the noise. Halving the size of patches removes three quarters of an error
    of second order, so a third of the last change remains.
    """
    errors, noise, images = against_renders(*refined)
    biases = np.sqrt(np.maximum(errors**2 - noise**2, 0))
    assert biases[1] < biases[0] / 2 and biases[2] < biases[1] / 2, (errors, noise)
    changed = np.sqrt(((images[2] - images[1]) ** 2).mean() / (images[2] ** 2).mean())
    assert errors[2] < np.hypot(changed / 3, 1.1 * noise)


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1, 2, 3, 4])
def test_terms_of_the_series_against_renders(refined, bounces):
    """By the same measure, for each term."""
    errors, noise, images = against_renders(*refined, truncated=bounces)
    changed = np.sqrt(((images[2] - images[1]) ** 2).mean() / (images[2] ** 2).mean())
    assert errors[2] < np.hypot(changed / 3, 1.1 * noise) + 1e-6


def test_an_operator_may_be_passed_to_jitted_functions(cornell):
    _, op = cornell
    compiled = jax.jit(lambda op: op.solve().L)
    np.testing.assert_allclose(compiled(op), op.solve().L, rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(not native(), reason="native loops are off")
def test_rays_are_cast_in_native_kernels(native_kernels, make_scene):
    scene = make_scene(plates())
    op = transport.operator(scene, 8)
    scene, number, seed = replace(scene, about=None), jnp.uint32(0), jnp.uint32(0)
    items = jnp.zeros(256, jnp.int32)
    for lowered in (
        rays._cast.lower(scene.geometry, op.patches, items, items, seed),
        factors._visibility.lower(scene.geometry, op.patches, items, items, jnp.int32(4), seed),
        view._seen.lower(scene, op.patches, items, number, seed),
    ):
        assert native_kernels(lowered) == 1


# ---- bad input ------------------------------------------------------------------------------------------------------


def test_light_that_does_not_die_out_is_refused(shipped):
    scene = pj.with_parameters(shipped("furnace", res=16), {"wall.reflectance": [0.5, 1, 0.5]})
    for method in transport.METHODS:
        op = transport.operator(scene, 24, method=method)
        for solver in ("gmres", "neumann"):
            with pytest.raises(pj.InputError, match="spectral radius of the operator is 1.0000"):
                op.solve(solver)
        assert op.solve("neumann", depth=3).L.shape == op.Le.shape


@pytest.mark.parametrize(
    "how, words",
    [
        ({"method": "neumann", "depth": 0}, "at least 1 term"),
        ({"method": "jacobi"}, "method 'jacobi' is unknown"),
        ({"depth": 3}, "a depth goes with"),
    ],
)
def test_what_cannot_be_solved_is_refused(shipped, how, words):
    op = transport.operator(shipped("furnace", res=16), 6)
    with pytest.raises(pj.InputError, match=words):
        op.solve(**how)
    with pytest.raises(pj.InputError, match="at least 1 term"):
        op.terms(0)


def test_hidden_emitters_are_refused(make_scene):
    scene = make_scene(plates(), hide="true")
    op = transport.operator(scene, 2)
    with pytest.raises(pj.InputError, match="hide_emitters"):
        transport.image(scene, op.radiosity(op.Le))
