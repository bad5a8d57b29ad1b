"""Fits to images: recovery, bounds, undetermined parameters, views, solvers, interruptions, bad input."""

import contextlib
import functools
import signal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import pathjax as pj
from pathjax.images import read_rgb, write_exr, write_png
from pathjax.inverse import report, weights
from pathjax.inverse.compiled_cache import identity
from pathjax.system.json_text import json_text

# A floor and a wall that light each other under a sky.
ROOM = """
<bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.6, 0.5, 0.2"/></bsdf>
<bsdf type="diffuse" id="wall"><rgb name="reflectance" value="0.2, 0.4, 0.7"/></bsdf>
<shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/>
  <translate y="-1"/></transform><ref id="floor"/></shape>
<shape type="rectangle"><transform name="to_world"><scale value="2"/><translate z="-1"/></transform>
  <ref id="wall"/></shape>
<emitter type="constant" id="sky"><rgb name="radiance" value="1, 0.9, 0.8"/></emitter>
"""
NAMES = ["floor.reflectance", "wall.reflectance"]
START = dict.fromkeys(NAMES, 0.4)
VIEW = {"res": 16, "depth": 5, "origin": "0, 0.5, 3", "fov": 50}


@pytest.fixture(scope="module")
def room(make_scene):
    return make_scene(ROOM, **VIEW)


@pytest.fixture(scope="module")
def target_image(room):
    return np.asarray(pj.render(room, 1024, seed=1))


# Not scoped to the module, so that tests of both kinds follow each other and share compiled programs.
@pytest.fixture(params=["exr", "png"])
def kind(request):
    return request.param


# Each kind of target has its own program; tests that do not depend on the kind use only one in quick runs.
EXR_FIRST = pytest.mark.parametrize("kind", ["exr", pytest.param("png", marks=pytest.mark.slow)], indirect=True)
PNG_FIRST = pytest.mark.parametrize("kind", [pytest.param("exr", marks=pytest.mark.slow), "png"], indirect=True)


def stored(image, path):
    """Write an image to a file of the kind that its suffix says; return the target read back."""
    image = np.asarray(image)
    if path.suffix == ".exr":
        write_exr(path, {name: image[..., i] for i, name in enumerate("RGB")}, {})
    else:
        write_png(path, image)
    return pj.read_target(path)


@pytest.fixture
def store(kind, tmp_path):
    return lambda image: stored(image, tmp_path / f"target.{kind}")


@pytest.fixture
def target(target_image, store):
    return store(target_image)


@pytest.mark.parametrize("power", [66, -66])
def test_a_power_of_two_in_the_light_changes_nothing(room, target_image, power):
    """Radiances of 1e20 and 1e-20: no square may leave the range of float32."""
    fit = pj.fit(room, target_image, NAMES, start=START, spp=32)
    sky = np.ldexp(np.asarray(pj.parameters(room)["sky.radiance"]), power)
    scaled = pj.with_parameters(room, {"sky.radiance": sky})
    found = pj.fit(scaled, np.ldexp(target_image, power), NAMES, start=START, spp=32)
    assert found.converged and fit.converged
    np.testing.assert_array_equal(found.covariance, fit.covariance)
    np.testing.assert_array_equal(found.images[0], np.ldexp(fit.images[0], power))
    for name in NAMES:
        np.testing.assert_array_equal(found.values[name], fit.values[name])


@pytest.mark.parametrize("power", [60, -60])
def test_radiances_are_recovered_in_any_unit(room, target_image, power):
    scale = np.ldexp(1.0, power)
    scaled = pj.with_parameters(room, {"sky.radiance": 0.5 * scale})
    fit = pj.fit(scaled, target_image * np.float32(scale), ["sky.radiance"], spp=32)
    assert fit.converged, fit.message
    z = (fit.values["sky.radiance"] / scale - [1, 0.9, 0.8]) / (fit.standard_errors["sky.radiance"] / scale)
    assert np.abs(z).max() < 4  # three values: a false alarm in 5000 runs


@pytest.fixture(scope="module")
def fit_of(room, target_image, tmp_path_factory):
    folder = tmp_path_factory.mktemp("targets")

    @functools.cache
    def fit(kind):
        return pj.fit(room, stored(target_image, folder / f"target.{kind}"), NAMES, start=START, spp=32)

    return fit


@pytest.fixture
def fitted(fit_of, kind):
    return fit_of(kind)


def z_scores(fit, truth):
    return np.concatenate([np.ravel((fit.values[n] - truth[n]) / fit.standard_errors[n]) for n in fit.values])


def test_albedos_are_recovered_within_their_errors(fitted, room):
    z = z_scores(fitted, pj.parameters(room))
    assert fitted.converged and not fitted.undetermined and not fitted.at_bound
    # One of 6 values lies beyond 4.5 sigma with a probability of 4e-5.
    assert np.abs(z).max() < 4.5
    errors = np.concatenate([fitted.standard_errors[n] for n in NAMES])
    assert (errors < 3e-3).all()
    np.testing.assert_allclose(np.sqrt(np.diag(fitted.covariance)), errors, rtol=1e-12)
    np.testing.assert_allclose(np.diag(fitted.correlation), 1, rtol=1e-12)


def test_the_fit_tells_its_history_and_its_scene(fitted, room):
    assert {entry["stage"] for entry in fitted.history} == {"approach", "refine"}
    assert all(entry["values"].keys() == set(fitted.components) for entry in fitted.history)
    np.testing.assert_allclose(pj.parameters(fitted.scene)[NAMES[0]], fitted.values[NAMES[0]], rtol=1e-6)
    assert fitted.images[0].shape == fitted.residuals[0].shape == (16, 16, 3)
    assert fitted.residuals[0].std() == pytest.approx(1)


@pytest.mark.slow
def test_stated_errors_match_the_errors_made(room, store):
    """20 seeds and targets, 6 scalars: the mean square of z is known to 0.13 if all are independent, to 0.3 if only the
    seeds are."""
    z = []
    for seed in range(20):
        target = store(pj.render(room, 256, seed=100 + seed))
        z.append(z_scores(pj.fit(room, target, NAMES, start=START, spp=32, seed=seed), pj.parameters(room)))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_values_at_their_bounds_are_reached_and_told(room, store):
    truth = {"floor.reflectance": [1.0, 0.5, 0.0], "wall.reflectance": [0.0, 0.0, 1.0]}
    target = store(pj.render(pj.with_parameters(room, truth), 1024, seed=1))
    fit = pj.fit(room, target, NAMES, start=START, spp=32)
    assert fit.converged
    for name, value in truth.items():
        assert (np.abs(fit.values[name] - value) < 5 * fit.standard_errors[name] + 1e-4).all()
        assert (fit.values[name] >= 0).all() and (fit.values[name] <= 1).all()
    # Noise pushes half of the values at a bound beyond it.
    assert set(fit.at_bound) <= {f"{n}.{c}" for n in NAMES for c in "rgb"} - {"floor.reflectance.g"}


def test_what_images_do_not_determine_is_named(make_scene):
    """One bounce in the corner, with the sky out of view: only the product of its radiance and the albedo shows."""
    scene = make_scene(ROOM, res=16, depth=2, origin="0, 0.5, 0.5", target="0, -1, -1", fov=40)
    target = np.asarray(pj.render(scene, 256, seed=1))
    fit = pj.fit(scene, target, ["sky.radiance", *NAMES], start={"sky.radiance": 0.5, **START}, spp=32)
    assert "do not determine" in fit.message
    assert len(fit.undetermined) == 3
    assert all(any(name.startswith("sky.radiance") for name in d) for d in fit.undetermined)
    assert all(np.isinf(e).all() for e in fit.standard_errors.values())
    # The image is fitted all the same: the residual is noise.
    assert fit.converged
    assert "not determined" in report.text(fit)
    json_text(report.facts(fit))


def test_a_parameter_that_does_not_show_is_named(make_scene, store):
    """One bounce off the floor, with the wall behind the camera's back."""
    scene = make_scene(ROOM, res=16, depth=2, origin="0, 1, 1.5", target="0, -1, 1", fov=20)
    target = store(pj.render(scene, 256, seed=1))
    fit = pj.fit(scene, target, NAMES, spp=32)
    assert np.isinf(fit.standard_errors["wall.reflectance"]).all()
    assert np.isfinite(fit.standard_errors["floor.reflectance"]).all()


@PNG_FIRST
def test_views_share_parameters_and_know_more_together(write_scene, room, target, fitted):
    """The second target is an array, whatever the first is."""
    other = pj.load_scene(write_scene(ROOM, res=16, depth=5, origin="1, 1, 2.5", fov=50))
    both = pj.fit([room, other], [target, np.asarray(pj.render(other, 1024, seed=2))], NAMES, start=START, spp=32)
    assert both.converged and len(both.images) == len(both.scenes) == 2
    assert np.abs(z_scores(both, pj.parameters(room))).max() < 4.5
    # The mean, and clearly lower: one pixel at an edge may dominate a single stated error, or the determinant.
    ratios = np.log([both.standard_errors[n] / fitted.standard_errors[n] for n in NAMES])
    assert np.exp(ratios.mean()) < 0.95


@pytest.mark.parametrize(
    "solver",
    [
        optx.BFGS(rtol=1e-4, atol=1e-4),
        *(pytest.param(each(rtol=1e-4, atol=1e-4), marks=pytest.mark.slow) for each in (optx.Dogleg, optx.GaussNewton)),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_other_solvers_approach_the_same_answer(room, target, solver):
    fit = pj.fit(room, target, NAMES, start=START, spp=32, solver=solver)
    assert fit.converged
    assert np.abs(z_scores(fit, pj.parameters(room))).max() < 4.5


def test_a_second_fit_of_the_problem_does_not_compile(make_scene, room, target_image, compilations):
    other = make_scene(ROOM, **VIEW)
    fits = [pj.fit(room, target_image, NAMES, start=START, spp=32, seed=0)]
    before = compilations.count
    fits += [pj.fit(scene, target_image, NAMES, start=START, spp=32, seed=5) for scene in (room, other)]
    assert compilations.count == before
    assert all(fit.compile_seconds < 0.1 * fit.run_seconds for fit in fits[1:])  # programs are reused
    first, second, same = (np.concatenate([fit.values[name] for name in NAMES]).tolist() for fit in fits)
    assert first != second == same


def test_programs_are_shared_by_solvers_that_are_the_same_and_by_no_others():
    def solver(rtol=1e-4, norm=optx.max_norm, **more):
        return optx.BFGS(rtol, 1e-4, norm=norm, **more)

    assert identity(solver()) == identity(solver())
    assert hash(identity(solver())) == hash(identity(solver()))
    arrays = [np.zeros(2000), np.r_[np.zeros(1000), 1, np.zeros(999)]]  # numpy's repr omits the middle
    norms = [lambda x: optx.max_norm(x), lambda x: optx.max_norm(x)]
    others = [
        solver(2e-4),
        optx.BFGS(1e-4, 2e-4),
        optx.LevenbergMarquardt(1e-4, 1e-4),
        optx.BestSoFarMinimiser(solver()),
        solver(use_inverse=False),
        *(solver(norm=norm) for norm in norms),
        *(solver(rtol=jnp.asarray(array)) for array in arrays),
    ]
    assert repr(others[-1]) == repr(others[-2])
    assert len({identity(other) for other in (solver(), *others)}) == 1 + len(others)


def test_an_interrupted_fit_returns_what_it_has(room, target):
    def stop(entry):
        if entry["stage"] == "refine":
            raise KeyboardInterrupt

    fit = pj.fit(room, target, NAMES, start=START, spp=32, progress=stop)
    assert not fit.converged and fit.message == "interrupted"
    # It was already near the truth.
    assert all(np.abs(fit.values[n] - pj.parameters(room)[n]).max() < 0.05 for n in NAMES)
    report.text(fit), json_text(report.facts(fit))


def test_a_signal_whose_exception_is_lost_ends_a_fit_after_its_step(room, target):
    def lose(entry):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    fit = pj.fit(room, target, NAMES, start=START, spp=32, progress=lose)
    assert fit.message == "interrupted" and len(fit.history) == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("start", [0.0, 7.0])
def test_a_scene_without_noise_is_fitted_to_rounding(make_scene, start):
    body = """<shape type="rectangle"><emitter type="area" id="lamp"><rgb name="radiance" value="2, 0.5, 1"/></emitter>
</shape>"""
    scene = make_scene(body, res=4, depth=1, fov=20)
    fit = pj.fit(scene, np.broadcast_to([2.0, 0.5, 1.0], (4, 4, 3)), ["lamp.radiance"], start={"lamp.radiance": start})
    assert fit.converged
    np.testing.assert_allclose(fit.values["lamp.radiance"], [2, 0.5, 1], rtol=1e-5)


def test_what_a_file_rounds_in_a_scene_without_noise_is_in_the_errors(make_scene, tmp_path):
    """All pixels are rounded alike, by up to half a step, so 48 values tell no more than 3 do."""
    lamp = '<emitter type="area" id="lamp"><rgb name="radiance" value="0.2, 0.5, 0.8"/></emitter>'
    scene = make_scene(f'<shape type="rectangle">{lamp}</shape>', res=4, depth=1, fov=20)
    write_png(tmp_path / "a.png", np.broadcast_to([0.2, 0.5, 0.8], (4, 4, 3)))
    fit = pj.fit(scene, pj.read_target(tmp_path / "a.png"), ["lamp.radiance"], start={"lamp.radiance": 1.0})
    assert fit.converged
    errors = fit.standard_errors["lamp.radiance"]
    # The error is uniform over a step: never beyond sqrt(3) standard errors.
    assert (np.abs(fit.values["lamp.radiance"] - [0.2, 0.5, 0.8]) < 1.8 * errors).all()
    assert (errors < 4e-3).all()


def test_a_scene_that_cannot_look_like_its_target_is_told(room, target_image, store):
    fit = pj.fit(room, store(target_image[::-1]), NAMES, start=START, spp=32)
    assert not fit.converged and "structure" in fit.message


# ---- clipped and rounded targets ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cornell(shipped):
    return shipped("cornell_box", res=32)


WHITE = {"white.reflectance": 0.5}


@pytest.fixture(scope="module")
def cornell_image(cornell):
    return np.asarray(pj.render(cornell, 1024, seed=7))


def test_a_clipped_sky_does_not_move_the_answer(room, tmp_path):
    """A target from a file knows what is clipped; in an array the sky seems to be 1, and no albedo makes it so."""
    bright = pj.with_parameters(room, {"sky.radiance": 3 * pj.parameters(room)["sky.radiance"]})
    target = stored(pj.render(bright, 1024, seed=7), tmp_path / "a.png")
    fit = pj.fit(bright, target, NAMES, start=START, spp=32)
    assert fit.converged
    assert np.abs(z_scores(fit, pj.parameters(room))).max() < 4.5
    fit = pj.fit(bright, read_rgb(tmp_path / "a.png"), NAMES, start=START, spp=32)
    assert max(np.abs(fit.values[name] - pj.parameters(room)[name]).max() for name in NAMES) > 0.1
    assert not fit.converged and "structure" in fit.message


@pytest.mark.slow
@PNG_FIRST
def test_a_lamp_that_is_clipped_does_not_move_the_answer(cornell, cornell_image, store):
    target = store(cornell_image)
    fit = pj.fit(cornell, target, list(WHITE), start=WHITE)
    assert fit.converged
    # One of 3 values lies beyond 4.5 sigma with a probability of 2e-5.
    assert np.abs(z_scores(fit, pj.parameters(cornell))).max() < 4.5
    assert (fit.standard_errors["white.reflectance"] < 2e-3).all()


@pytest.mark.slow
def test_a_clipped_image_of_which_nothing_is_known_is_told(cornell, cornell_image, tmp_path):
    """The same image as an array: the lamp seems to be 1, and no reflectance of white makes it so."""
    write_png(tmp_path / "a.png", cornell_image)
    fit = pj.fit(cornell, read_rgb(tmp_path / "a.png"), list(WHITE), start=WHITE)
    assert np.abs(fit.values["white.reflectance"] - pj.parameters(cornell)["white.reflectance"]).max() > 0.1
    assert not fit.converged and "structure" in fit.message


def test_a_clipped_pixel_says_that_no_darker_image_fits(room, target_image):
    """Only the floor is below the clipping level, and the rest is brighter than the scene can be."""
    image = np.where(np.arange(16)[:, None, None] < 10, 2.0, target_image)
    fit = pj.fit(room, pj.Target(image, ceiling=1.5), NAMES, start=START, spp=32)
    assert not fit.converged and "structure" in fit.message


@pytest.mark.parametrize("margin", [weights.CLIP_MARGIN, pytest.param(0, marks=pytest.mark.xfail(strict=True))])
def test_noise_that_is_clipped_does_not_move_the_answer(room, monkeypatch, margin):
    """Targets of 16 spp, the brightest 5 % clipped. If pixels are left out because of their own noise, the mean z of
    12 fits is far off; otherwise it is known to 0.3, and one of 6 lies beyond 1.3 with a probability of 4e-5."""
    monkeypatch.setattr(weights, "CLIP_MARGIN", margin)
    truth, z = pj.parameters(room), []
    for seed in range(12):
        image = np.asarray(pj.render(room, 16, seed=50 + seed))
        target = pj.Target(image, ceiling=float(np.percentile(image, 95)))
        fit = pj.fit(room, target, NAMES, start=START, spp=32, seed=seed)
        z.append(z_scores(fit, truth))
        assert fit.converged
    assert np.abs(np.mean(z, 0)).max() < 1.3


def test_pixels_that_are_left_out_may_hold_anything(room, target_image):
    measured = np.ones((16, 16, 1), bool)
    measured[3:6, 4:9] = False
    damaged = np.where(measured, target_image, np.nan)
    fit = pj.fit(room, pj.Target(damaged, measured=measured), NAMES, start=START, spp=32)
    assert fit.converged
    assert np.abs(z_scores(fit, pj.parameters(room))).max() < 4.5
    np.testing.assert_array_equal(np.isnan(fit.residuals[0]), np.broadcast_to(~measured, (16, 16, 3)))
    report.picture(fit, [damaged])


# ---- glass ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball(shipped):
    return shipped("glass_ball", res=64)  # as in the README, so that fits share its programs


@pytest.fixture(scope="module")
def ball_image(ball):
    return np.asarray(pj.render(ball, 512, seed=1))


@pytest.fixture
def ball_target(ball_image, store):
    return store(ball_image)


@EXR_FIRST
@pytest.mark.parametrize("start", [1.2, *(pytest.param(far, marks=pytest.mark.slow) for far in (1.05, 2.5))])
def test_ior_is_recovered_from_far(ball, ball_target, start):
    fit = pj.fit(ball, ball_target, ["glass.int_ior"], start={"glass.int_ior": start}, spp=32)
    assert fit.converged
    assert abs(fit.values["glass.int_ior"] - 1.5) < 4 * fit.standard_errors["glass.int_ior"] < 4 * 2e-3


@EXR_FIRST
def test_a_local_minimum_is_not_taken_for_the_answer(ball, ball_target):
    fit = pj.fit(ball, ball_target, ["glass.int_ior"], start={"glass.int_ior": 1.2}, spp=32, scan=False)
    assert abs(fit.values["glass.int_ior"] - 1.5) > 0.1
    assert not fit.converged and "structure" in fit.message


@pytest.mark.slow
def test_ior_and_colours_are_recovered_together(ball, ball_target):
    names = ["glass.int_ior", "pattern.color0", "pattern.color1"]
    fit = pj.fit(ball, ball_target, names, start={"glass.int_ior": 1.2, names[1]: 0.5, names[2]: 0.5}, spp=32)
    assert fit.converged
    assert np.abs(z_scores(fit, pj.parameters(ball))).max() < 4.5


# ---- rough metal ----------------------------------------------------------------------------------------------------

METAL = ["metal.alpha", "metal.specular_reflectance"]


@pytest.fixture(scope="module")
def rough_ball(write_scene, tmp_path_factory):
    """The file of a scene: a rough ball under an environment map of a grey room with windows."""
    sky = np.full((16, 32, 3), 0.4, np.float32)
    sky[3:7, 2:5], sky[4:8, 10:13], sky[9:13, 27:30] = (4, 5, 6), (6, 5, 4), (2, 4, 2)
    file = tmp_path_factory.mktemp("sky") / "sky.exr"
    write_exr(file, dict(zip("RGB", np.moveaxis(sky, -1, 0), strict=True)), {})
    metal = '''<bsdf type="roughconductor" id="metal"><string name="distribution" value="ggx"/>
<float name="alpha" value="0.15"/><rgb name="specular_reflectance" value="0.9, 0.6, 0.3"/></bsdf>'''
    light = f'<emitter type="envmap"><string name="filename" value="{file}"/></emitter>'
    return write_scene(f'<shape type="sphere">{metal}</shape>{light}', res=32, depth=2, fov=32)


@pytest.mark.slow
def test_roughness_and_colour_are_recovered_from_a_target_of_mitsuba(rough_ball):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    target = np.array(mi.render(mi.load_file(str(rough_ball)), spp=512, seed=3), float)
    scene = pj.load_scene(rough_ball)
    truth = {name: np.asarray(pj.parameters(scene)[name]) for name in METAL}
    for alpha in (0.03, 0.5):
        for color in (0.4, 0.95):
            fit = pj.fit(scene, target, METAL, start=dict(zip(METAL, (alpha, color), strict=True)), spp=64)
            assert fit.converged, fit.message
            # One of 4 values, the same from all starts, lies beyond 3.5 sigma with a probability of 2e-3.
            assert np.abs(z_scores(fit, truth)).max() < 3.5
            assert all((fit.standard_errors[name] < 0.02 * truth[name]).all() for name in METAL)


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change, words",
    [
        ({"names": []}, "nothing to fit"),
        ({"names": "floor.reflectance"}, "list of names"),
        ({"names": ["floor.reflectence"]}, "did you mean floor.reflectance"),
        ({"names": ["floor.reflectance"] * 2}, "named twice"),
        ({"start": {"floor.reflectance": 1.5}}, "start of floor.reflectance = .* lies outside its bounds"),
        ({"start": {"sky.radiance": 1}}, "not fitted"),
        ({"target": np.ones((8, 16, 3))}, "shape"),
        ({"target": np.full((16, 16, 3), np.nan)}, "not finite"),
        ({"target": np.full((16, 16, 3), -1.0)}, "negative"),
        ({"target": pj.Target(np.ones((16, 16, 3)), ceiling=1.0)}, "clipped or left out"),
        ({"target": pj.Target(np.ones((16, 16, 3)), measured=False)}, "clipped or left out"),
        ({"target": pj.Target(np.ones((16, 16, 3)), measured=np.ones((16, 16)))}, "of the shape"),
        ({"target": pj.Target(np.ones((16, 16, 3)), step=-1.0)}, "not negative"),
        ({"target": pj.Target(np.ones((16, 16, 3)), step=np.nan)}, "not negative"),
        ({"target": pj.Target(np.ones((16, 16, 3)), ceiling=0.0)}, "above 0"),
        ({"scene": []}, "at least one scene"),
        ({"spp": 0}, "spp"),
        ({"seed": -1}, "seed"),
        ({"solver": optx.Newton(rtol=1e-3, atol=1e-3)}, "Newton"),
    ],
)
def test_bad_input_is_refused_before_anything_is_rendered(room, monkeypatch, change, words):
    monkeypatch.setattr("pathjax.compile.mapping.native_map", None)
    monkeypatch.setattr(jax, "jit", None)
    arguments = {"scene": room, "target": np.ones((16, 16, 3)), "names": NAMES, **change}
    if change.get("scene") == []:
        arguments["target"] = []
    scene, target, names = (arguments.pop(k) for k in ("scene", "target", "names"))
    with pytest.raises(pj.InputError, match=words):
        pj.fit(scene, target, names, **arguments)


def test_fewer_pixels_than_unknowns_are_refused(make_scene):
    scene = make_scene(ROOM, res=2, depth=2)
    with pytest.raises(pj.InputError, match="4 pixels cannot determine 6 numbers"):
        pj.fit(scene, np.ones((2, 2, 3)), NAMES)
