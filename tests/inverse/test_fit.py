"""Parameters from images: recovery, bounds, what is not determined, views, solvers, interruptions, bad input."""

import json

import jax
import numpy as np
import optimistix as optx
import pytest

import pathjax as pj
from pathjax.inverse import report

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


@pytest.fixture(scope="module")
def room(make_scene):
    return make_scene(ROOM, res=16, depth=5, origin="0, 0.5, 3", fov=50)


@pytest.fixture(scope="module")
def target(room):
    return np.asarray(pj.render(room, 1024, seed=1))


@pytest.fixture(scope="module")
def fitted(room, target):
    return pj.fit(room, target, NAMES, start=START, spp=32)


def z_scores(fit, truth):
    return np.concatenate([np.ravel((fit.values[n] - truth[n]) / fit.standard_errors[n]) for n in fit.values])


def test_albedos_are_recovered_within_their_errors(fitted, room):
    z = z_scores(fitted, pj.parameters(room))
    assert fitted.converged and not fitted.undetermined and not fitted.at_bound
    # 6 numbers beyond 4.5 sigma by chance: 4e-5.
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
def test_stated_errors_match_the_errors_made(room):
    """20 seeds and targets, 6 numbers: the mean square of z is known to 0.13 if all are independent, 0.3 if channels
    are one."""
    z = []
    for seed in range(20):
        target = np.asarray(pj.render(room, 256, seed=100 + seed))
        z.append(z_scores(pj.fit(room, target, NAMES, start=START, spp=32, seed=seed), pj.parameters(room)))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_values_at_their_bounds_are_reached_and_told(room):
    truth = {"floor.reflectance": [1.0, 0.5, 0.0], "wall.reflectance": [0.0, 0.0, 1.0]}
    target = np.asarray(pj.render(pj.with_parameters(room, truth), 1024, seed=1))
    fit = pj.fit(room, target, NAMES, start=START, spp=32)
    assert fit.converged
    for name, value in truth.items():
        assert (np.abs(fit.values[name] - value) < 5 * fit.standard_errors[name] + 1e-4).all()
        assert (fit.values[name] >= 0).all() and (fit.values[name] <= 1).all()
    # Half of those that lie at a bound are pushed beyond it by noise.
    assert set(fit.at_bound) <= {f"{n}.{c}" for n in NAMES for c in "rgb"} - {"floor.reflectance.g"}


def test_what_images_do_not_determine_is_named(make_scene):
    """One bounce under a sky that is not seen: only the product of its radiance and the albedo shows."""
    scene = make_scene(ROOM, res=16, depth=2, origin="0, 0.5, 3", fov=50, hide="true")
    target = np.asarray(pj.render(scene, 256, seed=1))
    fit = pj.fit(scene, target, ["sky.radiance", *NAMES], start={"sky.radiance": 0.5, **START}, spp=32)
    assert "do not determine" in fit.message
    assert len(fit.undetermined) == 3
    assert all(any(name.startswith("sky.radiance") for name in d) for d in fit.undetermined)
    assert all(np.isinf(e).all() for e in fit.standard_errors.values())
    # The image is fitted all the same: what is left is noise.
    assert fit.converged
    assert "not determined" in report.text(fit)
    json.dumps(report.facts(fit), allow_nan=False)


def test_a_parameter_that_does_not_show_is_named(make_scene):
    body = ROOM + """<bsdf type="diffuse" id="hidden"><rgb name="reflectance" value="0.5"/></bsdf>
<shape type="sphere"><point name="center" x="0" y="0" z="90"/><ref id="hidden"/></shape>"""
    scene = make_scene(body, res=16, depth=2, origin="0, 0.5, 3", fov=50)
    target = np.asarray(pj.render(scene, 256, seed=1))
    fit = pj.fit(scene, target, ["floor.reflectance", "hidden.reflectance"], spp=32)
    assert np.isinf(fit.standard_errors["hidden.reflectance"]).all()
    assert np.isfinite(fit.standard_errors["floor.reflectance"]).all()


def test_views_share_parameters_and_know_more_together(write_scene, room, target, fitted):
    other = pj.load_scene(write_scene(ROOM, res=16, depth=5, origin="1, 1, 2.5", fov=50))
    both = pj.fit([room, other], [target, np.asarray(pj.render(other, 1024, seed=2))], NAMES, start=START, spp=32)
    assert both.converged and len(both.images) == len(both.scenes) == 2
    assert np.abs(z_scores(both, pj.parameters(room))).max() < 4.5
    # In the mean, and well: one pixel at an edge may dominate a stated error, or the determinant of all.
    ratios = np.log([both.standard_errors[n] / fitted.standard_errors[n] for n in NAMES])
    assert np.exp(ratios.mean()) < 0.95


@pytest.mark.parametrize(
    "solver",
    [optx.BFGS(rtol=1e-4, atol=1e-4), optx.Dogleg(rtol=1e-4, atol=1e-4), optx.GaussNewton(rtol=1e-4, atol=1e-4)],
    ids=lambda solver: type(solver).__name__,
)
def test_other_solvers_approach_the_same_answer(room, target, solver):
    fit = pj.fit(room, target, NAMES, start=START, spp=32, solver=solver)
    assert fit.converged
    assert np.abs(z_scores(fit, pj.parameters(room))).max() < 4.5


def test_a_second_fit_of_the_problem_does_not_compile(room, target, fitted):
    again = pj.fit(room, target, NAMES, start=START, spp=32, seed=5)
    assert again.compile_seconds < fitted.compile_seconds / 10
    assert again.values[NAMES[0]].tolist() != fitted.values[NAMES[0]].tolist()


def test_an_interrupted_fit_returns_what_it_has(room, target):
    def stop(entry):
        if entry["stage"] == "refine":
            raise KeyboardInterrupt

    fit = pj.fit(room, target, NAMES, start=START, spp=32, progress=stop)
    assert not fit.converged and fit.message == "interrupted"
    # It was near already.
    assert all(np.abs(fit.values[n] - pj.parameters(room)[n]).max() < 0.05 for n in NAMES)
    report.text(fit), json.dumps(report.facts(fit), allow_nan=False)


@pytest.mark.parametrize("start", [0.0, 7.0])
def test_a_scene_without_noise_is_fitted_to_rounding(make_scene, start):
    body = """<shape type="rectangle"><emitter type="area" id="lamp"><rgb name="radiance" value="2, 0.5, 1"/></emitter>
</shape>"""
    scene = make_scene(body, res=4, depth=1, fov=20)
    fit = pj.fit(scene, np.broadcast_to([2.0, 0.5, 1.0], (4, 4, 3)), ["lamp.radiance"], start={"lamp.radiance": start})
    assert fit.converged
    np.testing.assert_allclose(fit.values["lamp.radiance"], [2, 0.5, 1], rtol=1e-5)


def test_a_scene_that_cannot_look_like_its_target_is_told(room, target):
    fit = pj.fit(room, target[::-1], NAMES, start=START, spp=32)
    assert not fit.converged and "structure" in fit.message


# ---- glass ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball(shipped):
    return shipped("glass_ball", res=32)


@pytest.fixture(scope="module")
def ball_target(ball):
    return np.asarray(pj.render(ball, 512, seed=1))


@pytest.mark.parametrize("start", [1.2, *(pytest.param(far, marks=pytest.mark.slow) for far in (1.05, 2.5))])
def test_ior_is_recovered_from_far(ball, ball_target, start):
    fit = pj.fit(ball, ball_target, ["glass.int_ior"], start={"glass.int_ior": start}, spp=32)
    assert fit.converged
    assert abs(fit.values["glass.int_ior"] - 1.5) < 4 * fit.standard_errors["glass.int_ior"] < 4 * 2e-3


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


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change, words",
    [
        ({"names": []}, "nothing to fit"),
        ({"names": "floor.reflectance"}, "list of names"),
        ({"names": ["floor.reflectence"]}, "did you mean floor.reflectance"),
        ({"names": ["floor.reflectance"] * 2}, "named twice"),
        ({"start": {"floor.reflectance": 1.5}}, "outside its bounds"),
        ({"start": {"sky.radiance": 1}}, "not fitted"),
        ({"target": np.ones((8, 16, 3))}, "shape"),
        ({"target": np.full((16, 16, 3), np.nan)}, "not finite"),
        ({"target": np.full((16, 16, 3), -1.0)}, "negative"),
        ({"scene": []}, "at least one scene"),
        ({"spp": 0}, "spp"),
        ({"seed": -1}, "seed"),
        ({"solver": optx.Newton(rtol=1e-3, atol=1e-3)}, "Newton"),
    ],
)
def test_bad_input_is_refused_before_anything_is_rendered(room, monkeypatch, change, words):
    monkeypatch.setattr("pathjax.runtime.native_map", None)
    monkeypatch.setattr(jax, "jit", None)
    arguments = {"scene": room, "target": np.ones((16, 16, 3)), "names": NAMES, **change}
    if change.get("scene") == []:
        arguments["target"] = []
    scene, target, names = (arguments.pop(k) for k in ("scene", "target", "names"))
    with pytest.raises(pj.InputError, match=words):
        pj.fit(scene, target, names, **arguments)


def test_fewer_pixels_than_unknowns_are_refused(make_scene):
    scene = make_scene(ROOM, res=2, depth=2)
    with pytest.raises(pj.InputError, match="4 pixels cannot tell 6 numbers"):
        pj.fit(scene, np.ones((2, 2, 3)), NAMES)
