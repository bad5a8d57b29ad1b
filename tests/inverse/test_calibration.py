"""Standard errors that fits of many scalars state are as large as the errors that they make."""

import numpy as np
import pytest
from scipy import fft, linalg, ndimage

import pathjax as pj
from pathjax.inverse.dense import Dense, Equations, least_within


def fitted(scene, name, start, spp, **how):
    """Return the fit to a render of another seed, the truth, and error / standard error of the seen values."""
    truth = np.asarray(pj.parameters(scene)[name])
    target = np.asarray(pj.render(scene, 1024, seed=5))
    fit = pj.fit(scene, target, [name], start={name: np.full(truth.shape, start)}, spp=spp, **how)
    stated = fit.standard_errors[name]
    seen = np.isfinite(stated)
    return fit, truth, ((fit.values[name] - truth) / np.where(seen, stated, 1))[seen]


def assert_calibrated(ratios, least, most):
    """Assert the root mean square, 1 +- 1/sqrt(2 n) for n independent ratios; neighbours count as a third as many."""
    deviation = 1 / np.sqrt(2 * len(ratios) / 3)
    rms = np.sqrt(np.mean(ratios**2))
    assert least - 4 * deviation < rms < most + 4 * deviation, rms


@pytest.mark.slow
def test_errors_of_an_environment_map_seen_in_two_balls_are_as_stated():
    random = np.random.default_rng(0)
    sky = np.exp(ndimage.gaussian_filter(3 * random.normal(size=(16, 32, 3)), (1.5, 1.5, 0), mode="wrap"))
    film = {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}}
    camera = pj.Transform().look_at(origin=[0, 0.5, 6], target=[0, 0, 0], up=[0, 1, 0])
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.6, 0.6]}}
    scene = pj.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
            "sky": {"type": "envmap", "data": (sky / sky.mean()).astype(np.float32)},
            "mirror": {"type": "sphere", "center": [-1.1, 0, 0], "bsdf": {"type": "conductor", "material": "none"}},
            "ball": {"type": "sphere", "center": [1.1, 0, 0], "bsdf": diffuse},
        }
    )
    fit, truth, ratios = fitted(scene, "sky.radiance", 1.0, 64)
    assert fit.converged, fit.message
    assert 0.5 < len(ratios) / truth.size < 0.9
    # Noise of single pixels is known to 20 %.
    assert_calibrated(ratios, 0.8, 1.25)
    assert np.mean(np.abs(ratios) > 3) < 0.03
    # Texels that neither the balls nor the camera show are reported as unseen.
    assert not fit.seen["sky.radiance"].all()


@pytest.mark.slow
def test_errors_of_the_colours_of_vertices_are_as_stated():
    random, side = np.random.default_rng(2), 12
    x, z = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, side)] * 2))
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    corners = np.stack([first, first + 1, first + side, first + side + 1], -1)
    cloth = {
        "type": "mesh",
        "vertices": np.stack([x, 0.1 * np.sin(4 * x) * z, z], -1),
        "faces": np.concatenate([corners[:, [0, 2, 1]], corners[:, [1, 2, 3]]]),
        "vertex_color": random.uniform(0.2, 0.8, (side**2, 3)),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}},
    }
    camera = pj.Transform().look_at(origin=[0, 3, 1], target=[0.2, 0, 0], up=[0, 0, -1])
    film = {"type": "hdrfilm", "width": 40, "height": 40, "rfilter": {"type": "box"}}
    scene = pj.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {"type": "perspective", "fov": 32, "to_world": camera, "film": film},
            "lamp": {"type": "point", "position": [1, 3, 1], "intensity": {"type": "rgb", "value": [9, 9, 9]}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.3, 0.3]}},
            "cloth": cloth,
        }
    )
    fit, truth, ratios = fitted(scene, "cloth.vertex_color", 0.5, 16)
    assert fit.converged, fit.message
    assert len(ratios) > truth.size / 2
    assert_calibrated(ratios, 0.8, 1.25)


@pytest.mark.slow
@pytest.mark.parametrize("smoothness", [0.03, "auto"])
def test_errors_of_texels_smaller_than_pixels_are_as_stated(smoothness):
    """Six texels per pixel, drawn from the prior. The noise of J tells them apart, though no pixel does."""
    side, random = 48, np.random.default_rng(7)
    rate = 2 - 2 * np.cos(np.pi * np.arange(side) / side)  # squared differences of neighbours in cosine waves
    links = 2 * side * (side - 1) / (side**2 - 1)
    rate = (rate[:, None] + rate) / (links * 0.03**2)
    waves = random.normal(size=(side, side, 3)) / np.sqrt(np.where(rate > 0, rate, np.inf))[..., None]
    texels = (0.5 + fft.idctn(waves, axes=(0, 1), norm="ortho")).astype(np.float32)
    assert 0.05 < texels.min() < texels.max() < 0.95
    camera = pj.Transform().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 20, "height": 20, "rfilter": {"type": "box"}}
    picture = {"type": "bitmap", "data": texels, "raw": True}
    scene = pj.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {"type": "perspective", "fov": 28, "to_world": camera, "film": film},
            "lamp": {"type": "point", "position": [1, 1, 3], "intensity": {"type": "rgb", "value": [9, 9, 9]}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.3, 0.3]}},
            "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "id": "wall-bsdf", "reflectance": picture}},
        }
    )
    fit, _, ratios = fitted(scene, "wall-bsdf.reflectance", 0.5, 64, smoothness=smoothness)
    assert fit.converged, fit.message
    assert len(ratios) > texels.size / 2
    assert_calibrated(ratios, 0.8, 1.2)


def picture(kind, side=64):
    """Return texels (side, side, 3) that are not drawn from the prior."""
    random = np.random.default_rng(1)
    y, x = (np.mgrid[:side, :side] + 0.5) / side
    smooth = ndimage.gaussian_filter(random.normal(size=(side, side, 3)), (side / 10, side / 10, 0), mode="wrap")
    texels = 0.45 + 0.1 * smooth / smooth.std() * (kind in ("smooth", "spots"))
    if kind == "noise":
        texels = random.uniform(0.2, 0.8, texels.shape)
    for _ in range(12):
        middle, size, color = random.uniform(size=2), random.uniform(0.05, 0.2, 2), random.uniform(0.1, 0.9, 3)
        if kind == "edges":
            texels[(abs(x - middle[0]) < size[0]) & (abs(y - middle[1]) < size[1])] = color
        if kind == "spots":
            texels[(x - middle[0]) ** 2 + (y - middle[1]) ** 2 < (size[0] / 3) ** 2] = color
    return np.clip(texels, 0.05, 0.95).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, least", [("noise", 0.7), ("edges", 0.7), ("spots", 0.7), ("smooth", 0.0), ("constant", 0.0)]
)
def test_errors_of_pictures_are_as_stated(kind, least):
    """Seen at a slant, fitted by conjugate gradients. Textures smoother than edges may be known better than stated."""
    texels = picture(kind)
    film = {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}}
    camera = pj.Transform().look_at(origin=[0, 2, 3], target=[0, 0, 0], up=[0, 1, 0])
    lamp = pj.Transform().translate([0, 3, 0]).rotate([1, 0, 0], 90)
    bitmap = {"type": "bitmap", "data": texels, "raw": True, "wrap_mode": "clamp"}
    scene = pj.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "sensor": {"type": "perspective", "fov": 35, "to_world": camera, "film": film},
            "lamp": {
                "type": "rectangle",
                "to_world": lamp,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [5, 5, 5]}},
            },
            "floor": {
                "type": "rectangle",
                "to_world": pj.Transform().rotate([1, 0, 0], -90),
                "bsdf": {"type": "diffuse", "id": "carpet", "reflectance": bitmap},
            },
        }
    )
    fit, truth, ratios = fitted(scene, "carpet.reflectance", 0.5, 64, smoothness="auto")
    assert fit.converged, fit.message
    assert len(ratios) > 0.8 * truth.size
    assert least < np.sqrt(np.mean(ratios**2)) < 1.4


@pytest.mark.parametrize("spread", [1, 1e-4])
def test_a_step_ends_where_the_quadratic_is_least_within_bounds(spread):
    """Texels are strongly correlated and many end at a bound, for which the others compensate.

    spread: sensitivity of the last pixel to the texels, relative to the first.
    """
    random, count = np.random.default_rng(4), 60
    J = (random.uniform(size=(80, count)) + 2) * np.geomspace(1, spread, 80)[:, None]
    matrix, wanted = J.T @ J + 0.1 * spread**2 * np.eye(count), random.uniform(-1, 2, count)
    start = np.clip(wanted, 0, 1)
    found, free = least_within(matrix, matrix @ (start - wanted), start, np.zeros(count), np.ones(count))
    slope, rounding = matrix @ (found - wanted), 1e-9 * np.abs(matrix) @ np.abs(found - wanted)
    # The slope vanishes for free values, and draws the others beyond their bounds.
    assert (free == ((found > 0) & (found < 1))).all() and free.mean() < 0.75
    assert (np.abs(slope[free]) < rounding[free]).all()
    assert (slope[found == 0] > 0).all() and (slope[found == 1] < 0).all()


def test_errors_of_linear_equations_are_those_of_many_repetitions():
    """Pixels have unequal noise and some weigh less than they should; stated errors are those of this weighting."""
    random = np.random.default_rng(3)
    J, deviation, trust = random.uniform(size=(40, 6)), random.uniform(0.5, 2, 40), random.uniform(0.1, 1, 40)
    weights, P = trust / deviation**2, 4 * np.eye(6)
    matrix, scatter = J.T @ (weights[:, None] * J), J.T @ ((trust * weights)[:, None] * J)
    search = object.__new__(Dense)
    of_channels = [np.stack([x] * 3) for x in (matrix, scatter)]
    none = np.zeros((3, 6, 1))  # no noise of J
    found = Equations(of_channels[0], np.zeros((6, 3)), np.full((6, 3), np.inf), none, of_channels[1])
    search.sums, search.prior_matrix, search.samples, search.sharp = lambda variance: found, P, 8, 8
    search.prior, search.missing = type("Prior", (), {"scale": np.full(18, 10.0)}), deviation[:, None] ** 2
    search.find_errors(1.0)
    truth = random.normal(size=(6, 20000)) / 2
    pixels = J @ truth + deviation[:, None] * random.normal(size=(40, 20000))
    errors = linalg.solve(matrix + P, J.T @ (weights[:, None] * pixels)) - truth
    # 20000 repetitions determine a standard deviation to 0.5 %.
    np.testing.assert_allclose(search.standard_errors.reshape(6, 3)[:, 0], errors.std(1), rtol=0.025)
