"""Fits of textures: recovery within stated errors, texels that no pixel sees, the prior, bad input."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy import fft

import pathjax as pj
from pathjax.images import write_exr
from pathjax.inverse import dense, problem, products
from pathjax.inverse.many import Search
from pathjax.inverse.parameter_vector import ParameterVector
from pathjax.inverse.prior import KINDS, Prior
from pathjax.inverse.state import State
from pathjax.kinds.parameter import Parameter
from pathjax.scene import parameters as named
from pathjax.system import memory

NAME = "picture.reflectance"
SIZE = 16


@pytest.fixture(scope="module")
def wall(make_scene, tmp_path_factory):
    """A textured square in front of a lamp; the left part of the square is in view."""
    file = tmp_path_factory.mktemp("pictures") / "wall.exr"
    numbers = np.random.default_rng(1).uniform(0.2, 0.8, (3, SIZE, SIZE)).astype(np.float32)
    write_exr(file, dict(zip("RGB", numbers, strict=True)), {})
    picture = (
        f'<texture type="bitmap" name="reflectance"><string name="filename" value="{file}"/>'
        '<boolean name="raw" value="true"/></texture>'
    )
    return make_scene(
        f'<bsdf type="diffuse" id="picture">{picture}</bsdf>'
        '<shape type="rectangle"><transform name="to_world"><translate x="0.5"/></transform><ref id="picture"/></shape>'
        '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><translate z="5"/>'
        '</transform><emitter type="area" id="lamp"><rgb name="radiance" value="20, 18, 15"/></emitter></shape>',
        res=40,
        depth=2,
        fov=28,
    )


@pytest.fixture(scope="module")
def truth(wall):
    return np.asarray(pj.parameters(wall)[NAME])


@pytest.fixture(scope="module")
def target(wall):
    return np.asarray(pj.render(wall, 64, seed=9))


@pytest.fixture(scope="module", params=["by their matrix", "without it"])
def fit(request, wall, truth, target):
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "without it":
            patch.setattr(dense, "MOST_COLUMNS", 0)
        return pj.fit(wall, target, [NAME], start={NAME: np.full(truth.shape, 0.5)}, spp=16)


@pytest.mark.slow
def test_a_texture_is_recovered_within_its_errors(fit, truth):
    assert fit.converged, fit.message
    error, stated = fit.values[NAME] - truth, fit.standard_errors[NAME]
    known = stated < 0.1
    assert known.mean() > 0.3
    # Stated errors are uncertain by 10 to 20 %; chance adds 3 % for hundreds of texels.
    assert 0.7 < np.sqrt(np.mean((error / stated)[known] ** 2)) < 1.4
    assert np.sqrt(np.mean(error[stated < 0.02] ** 2)) < 0.025


@pytest.mark.slow
def test_texels_that_no_pixel_sees_are_named_and_keep_their_start(fit):
    seen = fit.seen[NAME]
    assert seen.shape == (SIZE, SIZE)
    # The square reaches from -0.5 to 1.5, and the view to tan(14 degrees) 4 = 1: to the twelfth texel and, at the other
    # end, where the texture repeats, the last one.
    assert not seen[:, 13:15].any() and seen[:, :12].all()
    assert np.isinf(fit.standard_errors[NAME][:, 13:15]).all()
    assert np.abs(fit.values[NAME][:, 13:15] - 0.5).max() < 0.05
    assert "tell nothing" in fit.message


@pytest.mark.slow
def test_the_result_is_that_of_any_fit(fit, wall, truth):
    np.testing.assert_array_equal(pj.parameters(fit.scene)[NAME], fit.values[NAME].astype(np.float32))
    assert fit.images[0].shape == (40, 40, 3) and fit.covariance is None and fit.correlation is None
    assert len(fit.components) == truth.size and {entry["stage"] for entry in fit.history} == {"descend"}
    spp = [entry["spp"] for entry in fit.history]
    assert spp == sorted(spp) and spp[-1] == 32


@pytest.mark.slow
def test_interrupted_fits_give_what_they_have(wall, truth, target):
    def interrupt(entry):
        raise KeyboardInterrupt

    found = pj.fit(wall, target, [NAME], start={NAME: np.full(truth.shape, 0.5)}, spp=16, progress=interrupt)
    assert not found.converged and found.message == "interrupted"
    assert np.isnan(found.standard_errors[NAME]).all() and (found.values[NAME] != 0.5).any()


@pytest.mark.parametrize(
    "start, how, says",
    [
        (np.zeros((8, 8, 3)), {}, [NAME, "16, 16, 3", "8 x 8 x 3"]),
        (0.5, {"smoothness": -1}, ["smoothness = -1", "auto"]),
        (0.5, {"smoothness": "much"}, ["smoothness = 'much'"]),
        (0.5, {"smoothness": "auto", "prior": "flat"}, ["prior = 'flat'", "'laplacian' or 'total variation'"]),
        (0.5, {"prior": "total variation"}, ["smoothness", "give it too"]),
        (0.5, {"solver": optx.BFGS(1e-3, 1e-3)}, ["solver", "leave it out"]),
    ],
)
def test_bad_input_is_refused(wall, target, start, how, says):
    with pytest.raises(pj.InputError) as refused:
        pj.fit(wall, target, [NAME], start={NAME: start}, **how)
    assert all(part in str(refused.value) for part in says)


def test_masks_that_leave_nothing_are_refused(wall, target):
    with pytest.raises(pj.InputError, match="every pixel"):
        pj.fit(wall, pj.Target(target, measured=np.zeros((40, 40, 1), bool)), [NAME])


def test_what_memory_has_no_room_for_is_refused(wall, target, monkeypatch):
    monkeypatch.setattr(memory, "limit", lambda: 1000)
    with pytest.raises(pj.InputError, match="768 numbers.*smaller texture"):
        pj.fit(wall, target, [NAME])


def test_smoothness_without_a_texture_is_refused(wall, target):
    with pytest.raises(pj.InputError, match="no.* is fitted"):
        pj.fit(wall, target, ["lamp.radiance"], smoothness=0.1)


@pytest.mark.parametrize("misfit", [0.9, 1.1])
def test_a_step_is_taken_back_if_it_misses_more_and_not_if_noise_turns_out_smaller(misfit):
    search, shape, noise = object.__new__(Search), (8, 8, 3), 0.01 * np.random.default_rng(9).normal(size=(2, 64, 3))
    search.problem = SimpleNamespace(targets=[SimpleNamespace(step=0.0, image=np.zeros(shape))])
    search.products = SimpleNamespace(kept=lambda views: views[0].reshape(-1, 3))
    search.usable, search.trust, search.accepted, search.damping = [np.ones(shape)], np.ones((64, 1)), None, 0.0
    search.target_part, search.render_part = None, 1 / 8
    for number, (missed, variance) in enumerate(((1.0, 4.0), (misfit, 0.01))):
        search.values = np.array([float(number)])
        search.render, search.variance = lambda _, m=missed: m + noise, lambda v=variance: [np.full(shape, v)]
        search.look(8)
    assert search.values == (misfit < 1) and (search.damping > 0) == (misfit > 1)


# ---- the prior ------------------------------------------------------------------------------------------------------


def texture(height, width):
    shape = height, width, 3
    return ParameterVector((("a", Parameter((), (0,), shape, (0.0, 1.0), rows=height * width)),))


def matrix(prior):
    return np.stack([prior.times(row) for row in np.eye(len(prior.mean))])


@pytest.mark.parametrize("kind", KINDS)
def test_the_precision_of_a_prior_is_that_of_its_gradient_diagonal_and_draws(kind):
    prior = Prior(texture(3, 4), np.full(36, 0.5), 0.2, kind)
    prior.estimate(np.random.default_rng(4).uniform(size=36), np.zeros(36), np.ones(36), {})
    P = matrix(prior)
    rounding = 1e-12 * np.diag(P).max()  # where sums of waves cancel
    np.testing.assert_allclose(P, P.T, atol=rounding)
    np.testing.assert_allclose(np.diag(P), prior.diagonal())
    x = np.random.default_rng(0).normal(size=36)
    np.testing.assert_allclose(prior.gradient(x) - prior.gradient(0 * x), P @ x, atol=rounding)
    # Equal texels have no differences, and the density is largest at the start.
    np.testing.assert_allclose(prior.gradient(prior.mean), 0, atol=1e-12)
    random = np.random.default_rng(0)
    draws = np.stack([prior.draw(random) for _ in range(1000)])
    spread = np.sqrt((np.diag(P)[:, None] * np.diag(P) + P**2) / 1000)
    assert np.abs((draws.T @ draws / 1000 - P) / spread).max() < 5  # 666 nearly normal values: a false alarm in 2000


def test_differences_of_texels_are_as_large_as_was_supposed():
    prior = Prior(texture(12, 12), np.full(432, 0.5), 0.02)
    covariance = np.linalg.inv(matrix(prior))
    random = np.random.default_rng(2)
    draws = (np.linalg.cholesky(covariance) @ random.normal(size=(432, 20))).T.reshape(20, 12, 12, 3)
    down, right = np.diff(draws, axis=1), np.diff(draws, axis=2)
    rms = np.sqrt((np.sum(down**2) + np.sum(right**2)) / (down.size + right.size))
    assert abs(rms / 0.02 - 1) < 0.02  # 8580 independent differences leave 0.8 %


def test_the_size_of_differences_is_found_where_values_are_known():
    vector, random = texture(24, 24), np.random.default_rng(3)
    prior = Prior(vector, np.full(1728, 0.5), "auto")
    prior.estimate(0.5 + 0.03 * random.normal(size=1728), np.zeros(1728), np.ones(1728), {"a": np.full((24, 24), 3.0)})
    # The root mean square difference of independent texels.
    assert abs(prior.difference["a"] / (0.03 * np.sqrt(2)) - 1) < 0.1


@pytest.mark.parametrize("power, found", [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (1.4, 1.4), (3.0, 1.5)])
def test_the_power_of_smoothness_is_found_where_values_are_known(power, found):
    """The size of differences is found with it. Texels are drawn with `power`; at most the power of edges is found."""
    prior, random = Prior(texture(24, 24), np.full(1728, 0.5), "auto"), np.random.default_rng(8)
    rate = 2 - 2 * np.cos(np.pi * np.arange(24) / 24)
    rate = rate[:, None] + rate
    waves = random.normal(size=(24, 24, 3)) / np.where(rate > 0, rate, np.inf)[..., None] ** (power / 2)
    texels = 0.5 + 0.03 * fft.idctn(waves, axes=(0, 1), norm="ortho")
    prior.estimate(texels.ravel(), np.zeros(1728), np.ones(1728), {"a": np.full((24, 24), 3.0)})
    # Logarithms of the rates of 1725 waves deviate by 0.7, so the error is 1 / (0.7 sqrt(1725 / 2)) = 0.05.
    assert abs(prior.power["a"] - found) < 0.2
    differences = np.diff(texels, axis=0), np.diff(texels, axis=1)
    rms = np.sqrt(np.mean(np.concatenate([d.ravel() for d in differences]) ** 2))
    assert power > 1.5 or abs(prior.difference["a"] / rms - 1) < 0.15


def test_the_precision_of_total_variation_is_that_of_its_derivative():
    """Its strength maximises the likelihood q^(3 T - 3) exp(-q sum |d|) of T colours about their mean."""
    vector, x = texture(12, 12), np.random.default_rng(5).uniform(size=432)
    prior = Prior(vector, np.full(432, 0.5), "auto", "total variation")
    for _ in range(30):
        prior.estimate(x, np.zeros(432), np.ones(432), {})
    image = x.reshape(12, 12, 3)
    down, right = np.zeros((2, 12, 12, 3))
    down[:-1], right[:, :-1] = np.diff(image, axis=0), np.diff(image, axis=1)
    length = np.sqrt((down**2 + right**2).sum(-1))
    # The last texel has no differences; where |d| = 0, precisions stay finite.
    q, (last, first) = 3 * 143 / length.sum(), (np.s_[:-1], np.s_[1:])
    slope = np.zeros((12, 12, 3))
    for d, of, to in ((down, last, first), (right, (np.s_[:], last), (np.s_[:], first))):
        unit = q * d / np.where(length > 0, length, 1)[..., None]
        slope[of] -= unit[of]
        slope[to] += unit[of]
    found = prior.gradient(x) - prior.precision * (x - prior.mean)
    np.testing.assert_allclose(found.reshape(12, 12, 3), slope, atol=1e-3 * q)


def test_total_variation_keeps_an_edge_that_the_laplacian_blurs():
    """A step between columns, seen through noise of a tenth of its height."""
    vector, random = texture(12, 12), np.random.default_rng(6)
    step = (np.where(np.arange(12) < 6, 0.3, 0.7)[None, :, None] * np.ones((12, 12, 3))).ravel()
    seen, weight, errors = step + 0.04 * random.normal(size=432), 0.04**-2, {}
    for kind in KINDS:
        prior = Prior(vector, np.full(432, 0.5), "auto", kind)
        for _ in range(8):
            covariance = np.linalg.inv(matrix(prior) + weight * np.eye(432))
            values = covariance @ (weight * seen + prior.precision * prior.mean)
            deviation = np.linalg.cholesky(covariance) @ random.normal(size=432)
            told = {name: weight * (a**2).sum(-1) for name, a in prior.waves_of(deviation).items()}
            prior.estimate(values, deviation, weight * np.diag(covariance), told)
        errors[kind] = np.sqrt(np.mean((values - step) ** 2))
    assert errors["total variation"] < 0.85 * errors["laplacian"], errors


SIDE = 160  # of a texture that is not fitted


def made(program, rows):
    """Return the primitives in a program, and those it calls, that create arrays of at least `rows` rows of 3."""
    found = []
    for eqn in program.eqns:
        inner = jax.tree.leaves(list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr"))
        inner = [each for each in (getattr(x, "jaxpr", x) for x in inner) if hasattr(each, "eqns")]
        for each in inner:
            found += made(each, rows)
        if not inner:
            shapes = [getattr(x.aval, "shape", ()) for x in eqn.outvars]
            found += [eqn.primitive.name for s in shapes if max(s, default=0) >= rows and np.prod(s) >= 3 * rows]
    return found


@pytest.fixture(scope="module")
def pictures():
    """A wall with a texture of 4 x 6 texels beside one with a large texture; all texels are in one array."""
    random, T = np.random.default_rng(3), pj.Transform
    camera = {"type": "perspective", "to_world": T().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": camera | {"film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}},
        "sky": {"type": "constant"},
    }
    for name, (x, shape) in {"large": (-1, (SIDE, SIDE, 3)), "small": (1, (4, 6, 3))}.items():
        data = random.uniform(0.2, 0.8, shape).astype(np.float32)
        bsdf = {"type": "diffuse", "id": name, "reflectance": {"type": "bitmap", "data": data, "raw": True}}
        scene[f"{name}-wall"] = {"type": "rectangle", "to_world": T().translate([x, 0, 0]), "bsdf": bsdf}
    return pj.load_dict(scene)


def evaluated(scenes, name):
    """Return the products of a fit of one texture, and the views that hold its start."""
    given = problem.build(scenes, [np.ones((8, 8, 3))] * len(scenes), [name], {name: 0.5})
    found = products.Products(given, seed=0)
    (group,) = found._at(given.start)
    assert found._at(given.start.copy())[0] is group
    return found, group


def test_no_kernel_of_a_fit_copies_texels_that_are_not_fitted(pictures):
    """Values are set once per step and arrays replicated beforehand, so no kernel creates an array of all texels."""
    views, group = evaluated([pictures, pj.with_parameters(pictures, {"sky.radiance": 2.0})], "small.reflectance")
    large = [x for x in jax.tree.leaves(group.scene) if x.size >= 3 * SIDE**2]
    assert len(large) == 1 and len(large[0].devices()) == len(jax.devices())
    (alone,) = views._at(views.problem.start, everywhere=False)  # for rows, which each device computes by itself
    assert all(len(x.devices()) == 1 for x in jax.tree.leaves(alone.scene))
    _, pixels, _ = views.parts[0]
    values = jnp.asarray(views.problem.start, jnp.float32)
    work = values, group, pixels, jnp.uint32(4), group.seeds(jnp.uint32(0), 0, 0)
    calls = {
        products._image: work,
        products._push: (*work, values),
        products._pull: (*work, jnp.ones((*pixels.shape, 3))),
        products._rows: work,
    }
    for function, arguments in calls.items():
        program = jax.make_jaxpr(partial(function, vector=views.vector))(*arguments)
        assert not made(program.jaxpr, SIDE**2), function.__name__


def test_values_of_a_texture_are_set_in_views_that_share_an_array_and_in_others(pictures):
    other = pj.with_parameters(pictures, {"large.reflectance": 0.1})
    for scenes, stacked in (([pictures], False), ([pictures, pictures], False), ([pictures, other], True)):
        _, group = evaluated(scenes, "small.reflectance")
        parameter = group.wanted["small.reflectance"]
        texels = np.asarray(named.get(group.scene, parameter.path))
        for view, scene in zip(texels if stacked else [texels] * len(scenes), scenes, strict=True):
            wanted = pj.with_parameters(scene, {"small.reflectance": 0.5})
            assert (view == np.asarray(named.get(wanted, parameter.path))).all()


def test_fits_of_few_numbers_have_large_arrays_on_all_devices(pictures):
    """An array on one device would be copied to the others at each call."""
    given = problem.build(pictures, np.ones((8, 8, 3)), ["sky.radiance"], {})
    (group,) = State(given, 8, 0, None, None, None).groups
    large = [x for x in jax.tree.leaves(group.scene) if x.size >= 3 * SIDE**2]
    assert large and all(len(x.devices()) == len(jax.devices()) for x in large)
