"""From a function of one item to the same function of many lanes, every number of an item in a register of its own.

`jax.vmap` puts an axis in front of each array: the x of two points then lie three apart, and stacking them costs
branches, so that LLVM vectorises little. This transformation keeps the components of every small array apart, each an
array (W,) over the lanes. Structure (stack, slice, reshape) then costs nothing, arithmetic is SIMD across the lanes,
and what all lanes share stays shared. Branches become selections; a loop goes on until its last lane is done.

- `one_by_one(f)` is run for each lane in turn: a search whose lanes would go different ways.
- `optimization_barrier(x)` is computed once. (XLA's own barrier is gone before fusion, which computes a value again for
  each of its consumers.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core


def one_by_one(f: Callable) -> Callable:
    """f, which `lanes` runs for one lane after another."""

    def one_by_one(*args):
        return f(*args)

    return jax.jit(one_by_one)


def lanes(f: Callable, width: int) -> Callable:
    """f(x, *shared) of `width` items x at once.

    Returns:
        function of xs, a pytree of arrays (width, ...), and of what all items share, to pytrees of arrays (width, ...).
    """

    def run(xs, *shared):
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs)
        program, out = jax.make_jaxpr(f, return_shape=True)(one, *shared)
        inputs = [_split(x) for x in jax.tree.leaves(xs)] + jax.tree.leaves(shared)
        # True, and no pass over HLO knows it.
        always = lax.population_count(jax.tree.leaves(xs)[0].ravel()[0].astype(jnp.int32)) >= 0
        outputs = _Lanes(width, always).run(program, inputs)
        return jax.tree.unflatten(jax.tree.structure(out), [_join(y, width) for y in outputs])

    return run


# ---- values: a jax array that all lanes share, or a NumPy array of objects, the components, each (W,) or () ---------


def _differs(value) -> bool:
    """Whether lanes hold values of their own."""
    return isinstance(value, np.ndarray) and value.dtype == object


def _objects(shape, items) -> np.ndarray:
    flat = np.empty(math.prod(shape), object)
    for place, item in enumerate(items):
        flat[place] = item
    return flat.reshape(shape)


def _split(x) -> np.ndarray:
    """(W, ...) -> components (...)."""
    columns = x.reshape(len(x), -1)
    return _objects(x.shape[1:], [columns[:, k] for k in range(columns.shape[1])])


def _join(value, width):
    """Components (...), or what is shared, -> (W, ...)."""
    if not _differs(value):
        return jnp.broadcast_to(value, (width, *jnp.shape(value)))
    columns = [jnp.broadcast_to(item, (width,)) for item in value.flat]
    return jnp.stack(columns, -1).reshape(width, *value.shape)


def _components(value) -> np.ndarray:
    if _differs(value):
        return value
    flat = jnp.ravel(value)
    return _objects(np.shape(value), [flat[k] for k in range(flat.size)])


def _fits(shape, whole) -> bool:
    """Whether an operand is one number, or repeats along axes of length 1."""
    return shape == () or len(shape) == len(whole) and all(a in (1, b) for a, b in zip(shape, whole, strict=True))


# ---- which values differ between lanes ------------------------------------------------------------------------------


def _callee(eqn) -> core.ClosedJaxpr | None:
    """What a call runs; None: this is no call."""
    for key in ("jaxpr", "call_jaxpr"):
        if key in eqn.params:
            program = eqn.params[key]
            return program if hasattr(program, "consts") else core.ClosedJaxpr(program, ())
    return None


def _while_parts(eqn, values):
    """Values of a while loop: constants of the condition, of the body, what is carried."""
    n, m = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    return values[:n], values[n : n + m], values[n + m :]


def _scan_parts(eqn, values):
    """Values of a scan: constants, what is carried, what is taken row by row."""
    if "num_consts" in eqn.params:
        n, m = eqn.params["num_consts"], eqn.params["num_carry"]
    else:  # jax 0.12
        n, m, _ = (len(tree.vals) for tree in eqn.params["ft_in"].unpack())
    return values[:n], values[n : n + m], values[n + m :]


def _settled(step, flags: list[bool]) -> list[bool]:
    """The least flags above these that `step` does not raise."""
    while (raised := [a or b for a, b in zip(flags, step(flags), strict=True)]) != flags:
        flags = raised
    return flags


def _flow(program: core.ClosedJaxpr, differing: list[bool]) -> list[bool]:
    """Which results may differ between lanes if these inputs do."""
    known = {v for v, d in zip(program.jaxpr.invars, differing, strict=True) if d}

    def flags(atoms):
        return [not isinstance(atom, core.Literal) and atom in known for atom in atoms]

    for eqn in program.jaxpr.eqns:
        outputs = _eqn_flow(eqn, flags(eqn.invars))
        known.update(v for v, d in zip(eqn.outvars, outputs, strict=True) if d)
    return flags(program.jaxpr.outvars)


def _eqn_flow(eqn, inputs: list[bool]) -> list[bool]:
    if not any(inputs):
        return [False] * len(eqn.outvars)
    match eqn.primitive.name:
        case "while":
            return _while_flow(eqn, inputs)
        case "scan":
            return _scan_flow(eqn, inputs)
        case "cond":
            results = [_flow(branch, inputs[1:]) for branch in eqn.params["branches"]]
            return [inputs[0] or any(each) for each in zip(*results, strict=True)]
    callee = _callee(eqn)
    return [True] * len(eqn.outvars) if callee is None else _flow(callee, inputs)


def _while_flow(eqn, inputs):
    test_consts, body_consts, carry = _while_parts(eqn, inputs)

    def step(carry):
        (goes_on,) = _flow(eqn.params["cond_jaxpr"], test_consts + carry)
        return [goes_on or d for d in _flow(eqn.params["body_jaxpr"], body_consts + carry)]

    return _settled(step, carry)


def _scan_flow(eqn, inputs):
    consts, carry, xs = _scan_parts(eqn, inputs)
    carry = _settled(lambda carry: _flow(eqn.params["jaxpr"], consts + carry + xs)[: len(carry)], carry)
    return carry + _flow(eqn.params["jaxpr"], consts + carry + xs)[len(carry) :]


# ---- the transformation ---------------------------------------------------------------------------------------------


class _Lanes:
    """Runs programs on values of `width` lanes."""

    def __init__(self, width: int, always):
        self.width, self.always = width, always

    def run(self, program: core.ClosedJaxpr, inputs) -> list:
        jaxpr = program.jaxpr
        values = dict(zip(jaxpr.constvars, program.consts, strict=True))
        values |= zip(jaxpr.invars, inputs, strict=True)
        used = {v for eqn in jaxpr.eqns for v in eqn.invars if not isinstance(v, core.Literal)}
        used |= {v for v in jaxpr.outvars if not isinstance(v, core.Literal)}

        def read(atom):
            return atom.val if isinstance(atom, core.Literal) else values[atom]

        for eqn in jaxpr.eqns:
            outputs = self.apply(eqn, [read(v) for v in eqn.invars], [v in used for v in eqn.outvars])
            values |= zip(eqn.outvars, outputs, strict=True)
        return [read(v) for v in jaxpr.outvars]

    def apply(self, eqn, inputs, used) -> list:
        name = eqn.primitive.name
        match name:
            case "while":
                return self.while_loop(eqn, inputs, used)
            case "scan":
                return self.scan(eqn, inputs)
            case "cond":
                return self.cond(eqn, inputs)
            case "optimization_barrier":
                return self.once(inputs)
        callee = _callee(eqn)
        if callee is not None:
            if eqn.params.get("name") == one_by_one.__name__:
                return self.one_by_one(callee, inputs)
            return self.run(callee, inputs)
        if not any(map(_differs, inputs)):
            outputs = eqn.primitive.bind(*inputs, **eqn.params)
            return list(outputs) if eqn.primitive.multiple_results else [outputs]
        shape = eqn.outvars[0].aval.shape
        if name in _RULES:
            result = _RULES[name](self, inputs, eqn.params, shape)
            if result is not None:
                return [result]
        elif len(eqn.outvars) == 1 and all(_fits(v.aval.shape, shape) for v in eqn.invars):
            return [self.each(partial(eqn.primitive.bind, **eqn.params), inputs, shape)]
        return self.by_vmap(eqn, inputs)

    # ---- arithmetic -------------------------------------------------------------------------------------------------

    def number(self, op, *operands):
        """op of numbers, each (W,) or () where shared."""
        if any(map(jnp.ndim, operands)):
            operands = [x if jnp.ndim(x) else jnp.broadcast_to(x, (self.width,)) for x in operands]
        return op(*operands)

    def each(self, op, inputs, shape):
        """op of each component; inputs have the shape or are single numbers."""
        columns = [np.broadcast_to(_components(x), shape).flat for x in inputs]
        return _objects(shape, [self.number(op, *operands) for operands in zip(*columns, strict=True)])

    def select(self, which, *cases):
        """By the number `which`, components of one of the cases; what is the same in all stays as it is."""
        columns = zip(*(_components(case).flat for case in cases), strict=True)
        items = [
            x[0] if all(other is x[0] for other in x) else self.number(lax.select_n, which, *x) for x in columns
        ]
        return _objects(np.shape(cases[0]), items)

    def once(self, values):
        """The values, of which every consumer reads one result: outcomes of a branch that is always taken."""
        items = [item for value in values for item in (value.flat if _differs(value) else [value])]
        results = iter(lax.cond(self.always, lambda *x: x, lambda *x: tuple(map(jnp.zeros_like, x)), *items))
        return [
            _objects(value.shape, [next(results) for _ in value.flat]) if _differs(value) else next(results)
            for value in values
        ]

    def by_vmap(self, eqn, inputs):
        """Any primitive: right, and slow."""
        joined = [_join(x, self.width) if _differs(x) else x for x in inputs]
        axes = [0 if _differs(x) else None for x in inputs]
        outputs = jax.vmap(partial(eqn.primitive.bind, **eqn.params), in_axes=axes)(*joined)
        return [_split(y) for y in (outputs if eqn.primitive.multiple_results else [outputs])]

    def one_by_one(self, program, inputs):
        def of_lane(mine):
            mine = iter(mine)
            return core.jaxpr_as_fun(program)(*[next(mine) if _differs(x) else x for x in inputs])

        return [_split(y) for y in lax.map(of_lane, [_join(x, self.width) for x in inputs if _differs(x)])]

    # ---- control flow -----------------------------------------------------------------------------------------------

    def pack(self, values, differing):
        """Values as pytrees of arrays, for a loop of XLA's to carry."""
        return [
            [jnp.broadcast_to(item, (self.width,)) for item in _components(value).flat] if differs else value
            for value, differs in zip(values, differing, strict=True)
        ]

    @staticmethod
    def unpack(packed, differing, shapes):
        return [
            _objects(shape, items) if differs else items
            for items, differs, shape in zip(packed, differing, shapes, strict=True)
        ]

    def while_loop(self, eqn, inputs, used):
        test_consts, body_consts, init = _while_parts(eqn, inputs)
        test, body = eqn.params["cond_jaxpr"], eqn.params["body_jaxpr"]
        differing = _eqn_flow(eqn, list(map(_differs, inputs)))
        shapes = [v.aval.shape for v in eqn.outvars]
        # A lane that is done stays as it is in what is read later; the rest of it may go on.
        tested = {v for e in test.jaxpr.eqns for v in e.invars if not isinstance(v, core.Literal)}
        kept = [u or v in tested for u, v in zip(used, test.jaxpr.invars[len(test_consts) :], strict=True)]

        def goes_on(packed):
            (result,) = self.run(test, [*test_consts, *self.unpack(packed, differing, shapes)])
            return result.item() if _differs(result) else result

        def advance(packed):
            carry = self.unpack(packed, differing, shapes)
            new = self.run(body, [*body_consts, *carry])
            on = goes_on(packed)
            if jnp.ndim(on):
                on = self.once([_objects((), [on])])[0].item()
                pairs = zip(carry, new, kept, strict=True)
                new = [self.select(on, old, value) if keep else value for old, value, keep in pairs]
            return self.pack(new, differing)

        packed = lax.while_loop(lambda packed: jnp.any(goes_on(packed)), advance, self.pack(init, differing))
        return self.unpack(packed, differing, shapes)

    def scan(self, eqn, inputs):
        consts, init, xs = _scan_parts(eqn, inputs)
        n = len(init)
        differing = _eqn_flow(eqn, list(map(_differs, inputs)))
        carried, rows = differing[:n], differing[n:]
        shapes = [v.aval.shape for v in eqn.outvars]
        row_shapes = [shape[1:] for shape in shapes[n:]]
        x_differs = list(map(_differs, xs))
        x_shapes = [np.shape(x)[1:] for x in xs]

        def step(packed, packed_x):
            carry = self.unpack(packed, carried, shapes[:n])
            x = self.unpack(packed_x, x_differs, x_shapes)
            results = self.run(eqn.params["jaxpr"], [*consts, *carry, *x])
            return self.pack(results[:n], carried), self.pack(results[n:], rows)

        def by_row(x):
            """Components (rows, ...) -> arrays (rows, W), one for each component of a row."""
            columns = x.reshape(len(x), -1).T
            return [jnp.stack([jnp.broadcast_to(item, (self.width,)) for item in column]) for column in columns]

        packed_xs = [by_row(x) if d else x for x, d in zip(xs, x_differs, strict=True)]
        last, ys = lax.scan(step, self.pack(init, carried), packed_xs, eqn.params["length"], eqn.params["reverse"])
        ys = [
            np.stack([_objects(shape, [item[k] for item in y]) for k in range(eqn.params["length"])]) if d else y
            for y, d, shape in zip(ys, rows, row_shapes, strict=True)
        ]
        return self.unpack(last, carried, shapes[:n]) + ys

    def cond(self, eqn, inputs):
        which, *operands = inputs
        branches = eqn.params["branches"]
        if _differs(which):
            which = self.once([which])[0].item()
            which = which != 0 if len(branches) == 2 else jnp.clip(which, 0, len(branches) - 1)
            results = [self.run(branch, operands) for branch in branches]
            return [self.select(which, *cases) for cases in zip(*results, strict=True)]
        differing = _eqn_flow(eqn, list(map(_differs, inputs)))
        calls = [lambda branch=branch: self.pack(self.run(branch, operands), differing) for branch in branches]
        return self.unpack(lax.switch(which, calls), differing, [v.aval.shape for v in eqn.outvars])


# ---- structure: (lanes, inputs, params, shape of the result) -> value; None: not by this rule ------------------------


def _broadcast_in_dim(lanes, inputs, params, shape):
    extents = [1] * len(shape)
    for axis, place in enumerate(params["broadcast_dimensions"]):
        extents[place] = inputs[0].shape[axis]
    return np.broadcast_to(inputs[0].reshape(extents), shape)


def _slice(lanes, inputs, params, shape):
    strides = params["strides"] or [1] * len(shape)
    limits = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return inputs[0][tuple(slice(*limit) for limit in limits)]


def _reduce(op):
    def rule(lanes, inputs, params, shape):
        axes = params["axes"]
        terms = np.moveaxis(inputs[0], axes, range(len(axes))).reshape(-1, math.prod(shape))
        while len(terms) > 1:
            half = len(terms) // 2
            folded = lanes.each(op, [terms[:half], terms[half : 2 * half]], (half, terms.shape[1]))
            terms = np.concatenate([folded, terms[2 * half :]])
        return terms.reshape(shape)

    return rule


def _dot_general(lanes, inputs, params, shape):
    (axes_a, axes_b), batch = params["dimension_numbers"]
    if any(batch) or len(axes_a) != 1:
        return None
    a, b = (np.moveaxis(_components(x), axes, [0]) for x, axes in zip(inputs, (axes_a, axes_b), strict=True))
    a, b = a.reshape(len(a), -1, 1), b.reshape(len(b), 1, -1)
    products = lanes.each(lax.mul, [a, b], (len(a), a.shape[1], b.shape[2]))
    return _reduce(lax.add)(lanes, [products], {"axes": (0,)}, shape)


def _dynamic_slice(lanes, inputs, params, shape):
    """Entries that lanes pick: gathered from a table that they share, selected from components of their own."""
    table, *starts = inputs
    starts = [start.item() if _differs(start) else start for start in starts]
    picked = []
    for axis, (start, size) in enumerate(zip(starts, shape, strict=True)):
        extent = table.shape[axis]
        if size == extent:
            continue
        if jnp.ndim(start) or _differs(table):
            picked.append(axis)
            if size > 1:  # of one entry, the gather clamps the number
                starts[axis] = jnp.clip(start, 0, extent - size)
        else:
            table = lax.dynamic_slice_in_dim(table, start, size, axis, allow_negative_indices=False)
    if _differs(table):
        for axis in picked:
            size, extent = shape[axis], table.shape[axis]
            windows = [np.take(table, range(k, k + size), axis) for k in range(extent - size + 1)]
            table = windows[0]
            for k, window in enumerate(windows[1:], 1):
                table = lanes.select(starts[axis] >= k, table, window)
        return table
    if not picked:
        return table
    extents = [table.shape[axis] for axis in picked]
    columns = jnp.moveaxis(table, picked, range(len(picked))).reshape(math.prod(extents), -1)
    blocks = []
    for offsets in np.ndindex(*(shape[axis] for axis in picked)):
        index = 0
        for axis, extent, offset in zip(picked, extents, offsets, strict=True):
            index = index * extent + (starts[axis].astype(jnp.int32) + offset)
        # One column at a time: gathered from a reshaped table, every index would be divided and multiplied again.
        blocks.append([_entries(columns[:, k], index) for k in range(columns.shape[1])])
    rest = [size for axis, size in enumerate(shape) if axis not in picked]
    block = _objects([*(shape[axis] for axis in picked), *rest], [item for items in blocks for item in items])
    return np.moveaxis(block, range(len(picked)), picked)


def _entries(column, index):
    numbers = lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(column, index[:, None], numbers, (1,), mode="clip")


def _gather(lanes, inputs, params, shape):
    """One block, as a slice of which some axes of length 1 may be dropped."""
    table, starts = inputs
    numbers = params["dimension_numbers"]
    in_bounds = params["mode"] in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    if np.ndim(starts) != 1 or not in_bounds:
        return None
    places = dict(zip(numbers.start_index_map, _components(starts), strict=True))
    offsets = [places.get(axis, jnp.int32(0)) for axis in range(np.ndim(table))]
    offsets = [_objects((), [x]) if jnp.ndim(x) else x for x in offsets]
    block = _dynamic_slice(lanes, [table, *offsets], params, params["slice_sizes"])
    return None if block is None else block.reshape(shape)


def _dynamic_update_slice(lanes, inputs, params, shape):
    table, update, *starts = inputs
    if len(starts) != 1 or np.shape(update)[0] != 1:
        return None
    start = starts[0].item() if _differs(starts[0]) else starts[0]
    (new,) = _components(update).flat
    items = [lanes.number(lax.select_n, start == k, old, new) for k, old in enumerate(_components(table))]
    return _objects(shape, items)


_RULES = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda lanes, x, params, shape: x[0].reshape(shape),
    "squeeze": lambda lanes, x, params, shape: x[0].reshape(shape),
    "expand_dims": lambda lanes, x, params, shape: x[0].reshape(shape),
    "transpose": lambda lanes, x, params, shape: x[0].transpose(params["permutation"]),
    "rev": lambda lanes, x, params, shape: np.flip(x[0], params["dimensions"]),
    "slice": _slice,
    "concatenate": lambda lanes, x, params, shape: np.concatenate(list(map(_components, x)), params["dimension"]),
    "stack": lambda lanes, x, params, shape: np.stack(list(map(_components, x)), params["axis"]),
    "select_n": lambda lanes, x, params, shape: lanes.each(lax.select_n, x, shape),
    "reduce_sum": _reduce(lax.add),
    "reduce_max": _reduce(lax.max),
    "reduce_min": _reduce(lax.min),
    "reduce_and": _reduce(lax.bitwise_and),
    "reduce_or": _reduce(lax.bitwise_or),
    "dot_general": _dot_general,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "dynamic_update_slice": _dynamic_update_slice,
    # Of the shape of their operands, and yet not component by component.
    **dict.fromkeys(("cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp", "sort", "scatter", "scatter-add",
                     "scatter-mul", "scatter_add", "scatter_mul", "argmin", "argmax"),
                    lambda lanes, x, params, shape: None),
}
