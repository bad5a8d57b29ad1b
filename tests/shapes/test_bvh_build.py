"""For any boxes the tree encloses and partitions them and finds brute force's hits; rules differ in cost only."""
import dataclasses
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathjax.shapes.accel import binary
from pathjax.shapes.accel.build import build
from pathjax.system import cores

RULES = ["sah", "equal", "middle"]


def random_boxes(n, seed=0, size=0.05):
    rng = np.random.default_rng(seed)
    centre, half = rng.random((n, 3)), rng.random((n, 3)) * size
    return centre - half, centre + half


def surface(n):
    """Return boxes of the 2 (n - 1)^2 triangles of a wavy sheet, as an example of a mesh."""
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    p = np.stack([u, v, 0.1 * np.sin(9 * u) * np.cos(7 * v)], -1).astype(np.float32)
    tri = np.concatenate([np.stack([p[:-1, :-1], p[1:, :-1], p[:-1, 1:]], 2).reshape(-1, 3, 3),
                          np.stack([p[1:, 1:], p[1:, :-1], p[:-1, 1:]], 2).reshape(-1, 3, 3)])
    return tri.min(1), tri.max(1)


def check(tree, lo, hi, leaf_size=8, width=8):
    """Assert every invariant that `Tree` states."""
    p, n, leaves = len(lo), len(tree.child), len(tree.leaf_first)
    assert tree.bounds.shape == (n, 2, 3, 8) and tree.child.shape == (n, 8)
    dtypes = [a.dtype for a in (tree.bounds, tree.child, tree.leaf_first, tree.leaf_count, tree.order)]
    assert dtypes == [np.float32] + 4 * [np.int32]
    assert np.array_equal(np.sort(tree.order), np.arange(p))
    assert np.array_equal(np.sort(tree.child[tree.child > 0]), np.arange(1, n))          # each node has one parent
    assert np.array_equal(np.sort(~tree.child[tree.child < 0]), np.arange(leaves))       # each leaf too
    assert 1 <= (tree.child != 0).sum(1).min() and (tree.child != 0).sum(1).max() <= width
    assert np.array_equal(np.isnan(tree.bounds), np.broadcast_to((tree.child == 0)[:, None, None], tree.bounds.shape))
    assert tree.leaf_count.min() >= 1 and tree.leaf_count.max() <= leaf_size
    assert np.array_equal(tree.leaf_first, np.cumsum(tree.leaf_count) - tree.leaf_count)  # so no primitive is in two
    assert tree.leaf_count.sum() == p and tree.sah_cost > 0
    leaf = np.repeat(np.arange(leaves), tree.leaf_count)
    assert (np.diff(tree.order)[leaf[1:] == leaf[:-1]] > 0).all()

    node, slot = np.nonzero(tree.child < 0)
    where = np.empty((leaves, 2), int)
    where[~tree.child[node, slot]] = np.stack([node, slot], 1)
    node, slot = where[leaf].T
    assert (tree.bounds[node, 0, :, slot] <= lo[tree.order]).all()
    assert (tree.bounds[node, 1, :, slot] >= hi[tree.order]).all()
    node, slot = np.nonzero(tree.child > 0)
    below = tree.bounds[tree.child[node, slot]]
    assert (tree.bounds[node, 0, :, slot] <= np.nanmin(below[:, 0], -1)).all()
    assert (tree.bounds[node, 1, :, slot] >= np.nanmax(below[:, 1], -1)).all()

    depth, level = 0, np.array([0])
    while len(level):
        depth, level = depth + 1, tree.child[level][tree.child[level] > 0]
    assert depth == tree.depth


def alike(first, *others):
    for other in others:
        for name in ("bounds", "child", "leaf_first", "leaf_count", "order"):
            assert np.array_equal(getattr(first, name), getattr(other, name), equal_nan=True)


def enter(lo, hi, o, d, axis):
    """Return where a ray enters boxes: inf if it misses or the box is NaN; `axis` is that of x, y, z."""
    shape = [3 if a == axis % lo.ndim else 1 for a in range(lo.ndim)]
    o, d = o.reshape(shape), d.reshape(shape)
    a, b = (lo - o) / d, (hi - o) / d
    near, far = np.minimum(a, b).max(axis), np.maximum(a, b).min(axis)
    return np.where(np.maximum(near, 0) <= far, np.maximum(near, 0), np.inf)


def closest_box(tree, lo, hi, o, d):
    """Walk the tree as the renderer does, nearest octant first; return the distance and the number of nodes tested."""
    best, nodes, stack = np.inf, 0, [0]
    octant = sum(int(d[a] < 0) << a for a in range(3))
    while stack:
        at = stack.pop()
        if at < 0:
            first = tree.leaf_first[~at]
            held = tree.order[first : first + tree.leaf_count[~at]]
            best = min(best, enter(lo[held], hi[held], o, d, 1).min())
            continue
        t = enter(tree.bounds[at, 0].astype(float), tree.bounds[at, 1].astype(float), o, d, 0)
        nodes += 1
        stack += [tree.child[at, k ^ octant] for k in range(7, -1, -1) if t[k ^ octant] < best]
    return best, nodes


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 17, 64, 65, 1000])
def test_invariants(rule, n):
    lo, hi = random_boxes(n)
    check(build(lo, hi, rule), lo, hi)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("leaf_size, width", [(1, 8), (1, 2), (3, 4), (4, 8), (8, 2), (20, 5)])
def test_other_leaf_sizes_and_widths(rule, leaf_size, width):
    lo, hi = random_boxes(500)
    check(build(lo, hi, rule, leaf_size, width), lo, hi, leaf_size, width)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("n", [1, 2, 9, 1000])
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_boxes_that_coincide_are_split_by_count(rule, n, size):
    lo = np.full((n, 3), 0.3)
    tree = build(lo, lo + size, rule)
    check(tree, lo, lo + size)
    assert tree.depth <= 1 + np.log2(max(n / 8, 1))


@pytest.mark.parametrize("rule", RULES)
def test_concentric_boxes(rule):
    half = np.linspace(0.1, 1, 300)[:, None] * np.ones(3)
    check(build(-half, half, rule), -half, half)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_points_on_a_line_are_split_along_it(axis):
    x = np.zeros((512, 3))
    x[:, axis] = np.random.default_rng(0).permutation(512)
    tree = build(x, x)
    check(tree, x, x)
    assert np.ptp(x[tree.order, axis].reshape(64, 8), axis=1).max() == 7     # leaves are runs of neighbours


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("scale", [1e-42, 1e-30, 1e-12, 1e12, 1e30, 3e38])
def test_extents_tiny_and_huge(rule, scale):
    lo, hi = (x * 0.9 * scale for x in random_boxes(500))
    tree = build(lo, hi, rule)
    check(tree, lo, hi)
    if scale >= 1e-30:
        assert tree.sah_cost == pytest.approx(build(lo / scale, hi / scale, rule).sah_cost, rel=1e-2)


def test_a_teapot_in_a_stadium():
    small, large = random_boxes(500), random_boxes(500, seed=1)
    lo = np.concatenate([small[0], large[0] * 1e6])
    hi = np.concatenate([small[1], large[1] * 1e6])
    tree = build(lo, hi)
    check(tree, lo, hi)
    assert tree.depth <= 8


@pytest.mark.parametrize("rule", RULES)
def test_ever_smaller_boxes_do_not_make_a_deep_tree(rule):
    x = 2.0 ** -np.arange(120.0)[:, None] * np.ones(3)
    tree = build(x, x * 1.5, rule)
    check(tree, x, x * 1.5)
    assert tree.depth <= {"sah": 6, "equal": 3, "middle": 20}[rule]


def test_bounds_are_rounded_outwards():
    lo = np.array([[0.1, 1 / 3, -0.1], [1e-50, -1e-50, 0.7]])                # none is a float32
    tree = build(lo, lo)
    check(tree, lo, lo)
    inner = tree.bounds[0, :, :, tree.child[0] < 0][0]
    assert (inner[0] < lo.min(0)).all() and (inner[1] > lo.max(0)).all()
    exact = np.float32([[0.1, 0.2, 0.3]])
    assert np.array_equal(build(exact, exact).bounds[0, 0, :, build(exact, exact).child[0] < 0][0], exact[0])


def test_equal_counts_give_a_balanced_tree():
    lo, hi = random_boxes(4096)
    tree = build(lo, hi, "equal")
    assert (tree.leaf_count == 8).all() and tree.depth == 3                  # 512 leaves, 8 x 8 x 8


def test_sah_is_the_cheapest_rule():
    for lo, hi in (random_boxes(3000), surface(60)):
        cost = {rule: build(lo, hi, rule).sah_cost for rule in RULES}
        assert cost["sah"] < 0.98 * min(cost["equal"], cost["middle"])


def test_one_leaf_costs_what_is_tested():
    lo, hi = random_boxes(5)
    tree = build(lo, hi)
    assert tree.sah_cost == pytest.approx(2) and tree.depth == 1             # the root's boxes, and one leaf as large


@pytest.mark.parametrize("boxes", [surface(60), random_boxes(4000)])
def test_splits_sought_in_two_steps_cost_about_as_little_as_all_tried(boxes, monkeypatch):
    cost = build(*boxes).sah_cost
    monkeypatch.setattr(binary, "PLACES", len(boxes[0]))
    assert cost < 1.02 * build(*boxes).sah_cost
    monkeypatch.setattr(binary, "PLACES", 2)  # the least: halves, and halves of halves
    check(build(*boxes), *boxes)


@pytest.mark.parametrize("rule", RULES)
def test_the_same_tree_on_any_number_of_cores(rule, monkeypatch):
    monkeypatch.setattr(cores, "SMALL", 0)
    monkeypatch.setattr(binary, "FEW", 100)
    monkeypatch.setattr(binary, "BATCH", 500)  # some nodes are split among cores, others are assigned to one
    trees = []
    for number in (1, 2, 5):
        monkeypatch.setattr(cores, "cores", lambda number=number: number)
        trees.append(build(*surface(40), rule))
    alike(*trees)


@pytest.mark.parametrize("rule", RULES)
def test_closest_box_is_that_of_brute_force(rule):
    lo, hi = random_boxes(700, size=0.02)
    tree, rng = build(lo, hi, rule), np.random.default_rng(3)
    for _ in range(100):
        o, d = rng.random(3) * 3 - 1, rng.normal(size=3)
        assert closest_box(tree, lo, hi, o, d)[0] == enter(lo, hi, o, d, 1).min()


def test_slots_put_the_nearest_child_first():
    lo, hi = random_boxes(3000, size=0.03)
    tree, rng = build(lo, hi), np.random.default_rng(4)
    rays = [(o, rng.random(3) - o) for o in rng.random((200, 3)) * 5 - 2]
    farthest_first = dataclasses.replace(tree, bounds=tree.bounds[..., ::-1], child=tree.child[:, ::-1])
    nodes, most = (sum(closest_box(t, lo, hi, o, d)[1] for o, d in rays) for t in (tree, farthest_first))
    assert nodes < 0.8 * most, (nodes, most)


coordinate = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0]), st.floats(-(2.0**100), 2.0**100, width=32), st.floats(-1, 1, width=32))
boxes = st.lists(st.tuples(*[coordinate] * 6), min_size=1, max_size=60)


@settings(max_examples=80, deadline=None)
@given(boxes, st.sampled_from(RULES), st.integers(1, 9), st.integers(2, 8))
def test_invariants_hold_for_any_boxes(corners, rule, leaf_size, width):
    corner = np.array(corners).reshape(-1, 2, 3)
    lo, hi = corner.min(1), corner.max(1)
    check(build(lo, hi, rule, leaf_size, width), lo, hi, leaf_size, width)


def test_the_same_tree_every_time():
    lo, hi = surface(40)
    alike(build(lo, hi), build(lo.astype(np.float64), hi.astype(np.float64)))


def test_refusals():
    box = np.zeros((3, 3))
    for bad in (np.nan, np.inf, 1e39):
        hi = box.copy()
        hi[1, 2] = bad
        with pytest.raises(ValueError, match="1 bounds .* first is number 1"):
            build(box, hi)
    with pytest.raises(ValueError, match="lo > hi"):
        build(box + 1, box)
    for lo in (np.zeros((0, 3)), np.zeros(3), np.zeros((3, 2))):
        with pytest.raises(ValueError, match=r"\(P, 3\)"):
            build(lo, lo)
    with pytest.raises(ValueError, match="'median' is not known; use one of sah, equal, middle"):
        build(box, box, "median")
    with pytest.raises(ValueError, match="width 2 to 8"):
        build(box, box, width=16)


@pytest.mark.slow
def test_a_million_boxes_in_seconds():
    lo, hi = surface(708)
    start = time.process_time()
    tree = build(lo, hi)
    assert time.process_time() - start < 15
    check(tree, lo, hi)
