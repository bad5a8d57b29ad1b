"""Many lights in a tree: chances of each light, and images that do not depend on them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import pathjax as pj
from pathjax import emitters
from pathjax.emitters import light_tree

# Chance that a correct choice fails one of these tests.
FALSE_ALARM = 1e-4
LIGHTS, SIDE = 13, 2.0


def room(depth=3, kinds=("rectangle", "sphere", "point"), sky=False, lights=LIGHTS):
    """Return a scene with lights in a box above the floor, of these kinds in turn."""
    rng, T = np.random.default_rng(5), pj.Transform
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth},
        "sensor": {
            "type": "perspective",
            "to_world": T().look_at([0, 2, 5], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(4), "bsdf": {"type": "diffuse"}},
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, -3]).scale(4), "bsdf": {"type": "diffuse"}},
    }
    if sky:
        scene["sky"] = {"type": "constant", "radiance": 0.1}
    for number in range(lights):
        place, bright = rng.uniform([-SIDE, 0.2, -SIDE], [SIDE, 1, SIDE]).tolist(), rng.uniform(1, 9)
        radiance = {"type": "area", "radiance": {"type": "rgb", "value": [bright, bright / 2, bright / 3]}}
        scene[f"light{number}"] = {
            "rectangle": {"type": "rectangle", "to_world": T().translate(place).rotate([1, 0, 0], 90).scale(0.2)},
            "sphere": {"type": "sphere", "center": place, "radius": 0.1},
            "point": {"type": "point", "position": place, "intensity": bright / 20},
        }[kinds[number % len(kinds)]]
        if kinds[number % len(kinds)] != "point":
            scene[f"light{number}"] |= {"emitter": radiance, "bsdf": {"type": "diffuse"}}
    return pj.load_dict(scene)


@pytest.mark.parametrize("count", [2, 3, 9, 16, 100])
def test_each_light_has_a_leaf_of_its_own_near_its_neighbours(count):
    middles = np.random.default_rng(count).uniform(size=(count, 1, 3))
    leaf = light_tree.arranged(np.repeat(middles, 3, 1))
    assert len(set(leaf.tolist())) == count
    assert 0 <= leaf.min() <= leaf.max() < 2 * count
    along = np.argsort(middles[:, 0, np.ptp(middles[:, 0], axis=0).argmax()])
    rooms = light_tree.leaves(count) // 2
    assert set(along[: (count + 1) // 2]) == set(np.flatnonzero(leaf < rooms))


@pytest.mark.parametrize("sky", [False, True])
def test_lights_are_found_as_often_as_their_probabilities_say(sky):
    scene = room(sky=sky)
    chosen = jax.jit(lambda lights: emitters.choice(lights, "mis"))(scene.emitters)
    count, draws = chosen.pdf.shape[0], 1 << 12
    u = jnp.stack([(jnp.arange(draws) + 0.5) / draws, jnp.full((draws,), 0.25)], 1).astype(jnp.float32)
    choose = jax.jit(jax.vmap(lambda ref, u: emitters.choose(chosen, ref, u), (None, 0)))
    probability = jax.jit(jax.vmap(lambda ref, n: emitters.probability(chosen, ref, n), (None, 0)))
    for ref in np.random.default_rng(1).uniform(-SIDE, SIDE, (2, 3)).astype(np.float32):
        number, likely, again = choose(ref, u)
        near = LIGHTS if sky else count
        known = probability(ref, jnp.arange(near))
        known = np.append(known, chosen.pdf[near:])
        np.testing.assert_allclose(known.sum(), 1, rtol=1e-5)
        np.testing.assert_allclose(likely, known[number], rtol=1e-5)
        # Numbers are evenly spaced, so each of the two borders of a light shifts its count by at most one.
        np.testing.assert_allclose(np.bincount(number, minlength=count), known * draws, atol=4)
        assert stats.kstest(np.asarray(again[:, 0]), "uniform").pvalue > FALSE_ALARM


def tree_of(points, normals, power):
    """Return the tree of small lights."""
    places = np.stack([points, points, normals], 1).astype(np.float32)
    leaf = light_tree.arranged(places)
    return jax.jit(light_tree.built)(jnp.asarray(places), jnp.asarray(leaf), jnp.asarray(power, jnp.float32))


probability = jax.jit(light_tree.probability)


def test_lights_that_face_a_point_are_chosen_more_often():
    """Two flat lights by their cosines; beside one that faces away, a round one by a quarter of its power."""
    tilted = [(0, 0, 1), (0, np.sin(0.9), np.cos(0.9))]
    tree = tree_of([(0, 0, 0), (0, 0, 0)], tilted, [1, 1])
    least = light_tree._LEAST_AROUND / 4
    first, second = (float(probability(tree, jnp.array([0, 0, 7.0]), n)) for n in (0, 1))
    np.testing.assert_allclose(second / first, (np.cos(0.9) + least) / (1 + least), rtol=1e-5)
    tree = tree_of([(0, 0, 0), (0, 0, 0)], [(0, 0, -1), (0, 0, 0)], [1, 1])
    away, round = (float(probability(tree, jnp.array([0, 0, 7.0]), n)) for n in (0, 1))
    np.testing.assert_allclose(away / round, least / 0.25, rtol=1e-5)


def test_near_and_bright_lights_are_chosen_more_often():
    tree = tree_of([(0, 0, 0), (10, 0, 0), (10, 5, 0), (10, 9, 0)], np.zeros((4, 3)), [1, 1, 8, 0])
    beside = [float(probability(tree, jnp.array([0.5, 0, 0]), n)) for n in range(4)]
    assert beside[0] > 5 * 0.1  # its share of the power
    assert beside[2] > beside[1] and beside[3] == 0


@pytest.mark.slow
def test_images_do_not_depend_on_how_lights_are_chosen(agree, estimate, monkeypatch):
    """With lights chosen by the tree, by power, or hit by bsdf samples alone."""
    with_tree = room(kinds=("rectangle", "sphere"), sky=True)
    monkeypatch.setattr(light_tree, "FEWEST", LIGHTS + 1)
    by_power = room(kinds=("rectangle", "sphere"), sky=True)
    assert emitters.chosen_by_place(with_tree.emitters) and not emitters.chosen_by_place(by_power.emitters)
    mis = estimate(with_tree, 64)
    agree(mis, estimate(by_power, 64, first_seed=101))
    agree(mis, estimate(with_tree, 64, first_seed=201, strategy="light"))
    agree(mis, estimate(with_tree, 1024, first_seed=301, strategy="bsdf"))


@pytest.mark.slow
def test_derivatives_know_which_light_was_chosen():
    """J^T v by the sweep, which looks up the lights again, against J v by tangents."""
    scene = room(kinds=("rectangle", "sphere"))
    names = [f"light{number}.radiance" for number in range(LIGHTS)]
    rng = np.random.default_rng(0)
    values = pj.parameters(scene)
    at = {name: values[name] for name in names}
    towards = {name: jnp.asarray(rng.normal(size=3), jnp.float32) for name in names}

    def image(at):
        return pj.render(pj.with_parameters(scene, at), 8, 3)

    _, forwards = jax.jvp(image, (at,), (towards,))
    v = jnp.asarray(rng.normal(size=forwards.shape), jnp.float32)
    (backwards,) = jax.vjp(image, at)[1](v)
    inner = sum(float(jnp.vdot(backwards[name], towards[name])) for name in names)
    np.testing.assert_allclose(inner, float(jnp.vdot(forwards, v)), rtol=1e-4)
