"""The counting walk finds the hits of brute force; its counts agree with the renderer's traversal and the SAH cost."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import pathjax as pj
from pathjax.bench.walk import distances, walk
from pathjax.io.mitsuba import loader as mitsuba_xml
from pathjax.scene import build
from pathjax.shapes.accel import build as bvh_build
from pathjax.shapes.accel import traverse as bvh

RULES = list(bvh_build.RULES)


def triangles(count, size, seed):
    rng = np.random.default_rng(seed)
    corners = rng.random((count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    return corners.astype(np.float32)


def tree_of(vertices, rule="sah"):
    return bvh_build.build(vertices.min(1), vertices.max(1), rule)


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def random_rays(count, seed):
    """Return rays from in and around the unit cube, a tenth of them along the axes."""
    rng = np.random.default_rng(seed)
    d = unit(rng.normal(size=(count, 3)))
    d[::10] = np.eye(3)[rng.integers(3, size=len(d[::10]))] * rng.choice([-1, 1], (len(d[::10]), 1))
    return rng.random((count, 3)) * 2 - 0.5, d


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("count, size", [(1, 1), (9, 0.5), (3000, 0.03)])
def test_hits_are_those_of_brute_force(rule, count, size):
    vertices = triangles(count, size, seed=1)
    o, d = random_rays(400, seed=2)
    found = walk(tree_of(vertices, rule), vertices, o, d)
    exact = distances(vertices[None].astype(float), o[:, None], d[:, None])
    np.testing.assert_array_equal(found.t, exact.min(1))
    np.testing.assert_array_equal(found.triangle, np.where(np.isfinite(exact.min(1)), exact.argmin(1), -1))
    assert 0 < np.isfinite(found.t).sum() < len(o)


def test_counts_of_a_tree_that_is_known():
    """Two leaves of 8 side by side; rays meet one of them, both, or none."""
    one = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vertices = np.concatenate([one + np.float32([x, 0, 0.1 * k]) for x in (0, 4) for k in range(8)]).reshape(-1, 3, 3)
    tree = tree_of(vertices)
    assert tree.leaf_count.tolist() == [8, 8] and len(tree.child) == 1
    o = [[0.2, 0.2, -1], [4.2, 0.2, -1], [2, 0.2, -1], [-1, 0.2, 0.05], [6, 0.2, 0.001]]
    d = [[0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0], unit(np.array([-1, 0, -1e-3]))]
    found = walk(tree, vertices, o, d)
    assert found.nodes.tolist() == [1] * 5 and found.boxes.tolist() == [2] * 5
    assert found.leaves.tolist() == [1, 1, 0, 2, 1]
    assert found.triangles.tolist() == [8, 8, 0, 16, 8]
    np.testing.assert_allclose(found.t[:2], 1)
    assert np.isinf(found.t[2:4]).all()


@pytest.mark.parametrize("rule", RULES)
def test_lines_meet_as_many_nodes_and_leaves_as_the_sah_cost_says(rule):
    """Uniform random lines through the root's box that hit nothing; a z-test with a false-alarm rate of 1e-4."""
    vertices = triangles(2000, 0.03, seed=3)
    tree = tree_of(vertices, rule)
    rng, count = np.random.default_rng(4), 40_000
    lo, hi = np.nanmin(tree.bounds[0, 0], -1).astype(float), np.nanmax(tree.bounds[0, 1], -1).astype(float)
    extent = hi - lo
    areas = np.prod(extent) / extent
    # From uniform points on the box, with cosine-distributed directions about its normal.
    axis, side = rng.choice(3, count, p=areas / areas.sum()), rng.integers(2, size=count)
    o = lo + extent * rng.random((count, 3))
    o[np.arange(count), axis] = np.where(side, hi[axis], lo[axis])
    u, turn = rng.random(count), 2 * np.pi * rng.random(count)
    local = np.stack([np.sqrt(1 - u) * np.where(side, -1, 1), np.sqrt(u) * np.cos(turn), np.sqrt(u) * np.sin(turn)])
    d = np.stack([local[(a - axis) % 3, np.arange(count)] for a in range(3)], -1)
    found = walk(tree, np.zeros_like(vertices), o, d)
    met = found.nodes + found.leaves
    z = (met.mean() - tree.sah_cost) / (met.std() / np.sqrt(count))
    assert abs(z) < stats.norm.isf(1e-4 / 2)


@pytest.mark.parametrize("rule", RULES)
def test_leaves_and_triangles_are_those_of_the_renderers_traversal(root, rule):
    """One in a thousand float32 rays may graze a box differently than in float64."""
    scene = build(mitsuba_xml.load(root / "scenes" / "mesh.xml", res=8), split_rule=rule)
    table, built = scene.geometry.tables[-1], scene.about.trees["triangle"]
    rng = np.random.default_rng(5)
    o = np.float32(rng.normal(size=(2000, 3)) * 6)
    d = np.float32(unit(rng.normal(size=o.shape) - o))
    vertices = np.asarray(table.vertices)
    found = walk(built, vertices, o, d)
    counts = jnp.asarray(built.leaf_count)
    corners, order, first = (jnp.asarray(x) for x in (vertices, built.order, built.leaf_first))

    def one(o, d):
        def leaf(number, t, carried):
            leaves, triangles = carried
            rows = order[jnp.minimum(first[number] + jnp.arange(8), len(order) - 1)]
            a, b, c = jnp.moveaxis(corners[rows], 1, 0)
            normal = jnp.cross(b - a, c - a)
            distance = jnp.sum((a - o) * normal, -1) / (normal @ d)
            p = o + distance[:, None] * d
            sides = [jnp.sum(jnp.cross(y - x, p - x) * normal, -1) for x, y in ((a, b), (b, c), (c, a))]
            inside = (jnp.stack(sides) >= 0).all(0) & (distance > 0) & (jnp.arange(8) < counts[number])
            nearest = jnp.min(jnp.where(inside, distance, jnp.inf))
            return jnp.minimum(t, nearest), (leaves + 1, triangles + counts[number])

        slabs, far = bvh.prepare(o, d), jnp.float32(1e30)
        t, carried = bvh.traverse(table.tree, leaf, slabs, bvh.enter(table.tree, slabs, far), far, (jnp.int32(0),) * 2)
        return t, *carried

    _, leaves, tested = jax.jit(lambda o, d: jax.lax.map(lambda ray: one(*ray), (o, d)))(o, d)
    assert (np.asarray(leaves) == found.leaves).mean() > 0.999
    assert (np.asarray(tested) == found.triangles).mean() > 0.999
    assert found.leaves.mean() > 1


def in_arrays_of_one_size(scenes):
    """Yield scenes that differ only in the tree of their one mesh, padded to the same array sizes to share kernels."""
    tables = [scene.geometry.tables[0] for scene in scenes]
    nodes, leaves = (max(map(len, arrays)) for arrays in ([t.tree.nodes for t in tables], [t.leaves for t in tables]))
    depth = max(table.tree.depth for table in tables)

    def longer(x, size):
        return np.pad(x, [(0, size - len(x)), *[(0, 0)] * (x.ndim - 1)])

    for scene, table in zip(scenes, tables, strict=True):
        tree = replace(table.tree, nodes=longer(table.tree.nodes, nodes), depth=depth)
        table = replace(table, tree=tree, leaves=longer(table.leaves, leaves))
        yield replace(scene, geometry=replace(scene.geometry, tables=(table,)))


def test_rules_change_no_hit(root, write_scene):
    mesh = f'<shape type="ply"><string name="filename" value="{root}/scenes/meshes/knot.ply"/></shape>'
    description = mitsuba_xml.load(write_scene(mesh))
    scenes = {rule: build(description, split_rule=rule) for rule in RULES}
    assert len({len(scene.about.trees["triangle"].child) for scene in scenes.values()}) == 3
    scenes = dict(zip(RULES, in_arrays_of_one_size(list(scenes.values())), strict=True))
    o, towards = np.random.default_rng(6).normal(size=(2, 4000, 3)) * [[[6]], [[2]]]
    hits = {rule: pj.closest_hit(scene, o, towards - o) for rule, scene in scenes.items()}
    sah, middle = (np.asarray(pj.any_hit(scenes[rule], o, towards - o)) for rule in ("sah", "middle"))
    assert 0.1 < np.isfinite(hits["sah"].t).mean() < 0.9
    for rule in RULES[1:]:
        for a, b in zip(hits[rule], hits["sah"], strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(sah, np.isfinite(hits["sah"].t))
    np.testing.assert_array_equal(middle, sah)


def test_an_unknown_rule_is_refused_even_where_there_is_no_tree(root):
    description = mitsuba_xml.load(root / "scenes" / "furnace.xml")
    with pytest.raises(pj.InputError, match="split_rule 'median' is unknown; use one of sah, equal, middle"):
        build(description, split_rule="median")
