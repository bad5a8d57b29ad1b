"""An interpreter that runs a program of one item on the values of many lanes."""

from __future__ import annotations

from functools import partial
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.compile.jax_compat import (
    ClosedJaxpr,
    Literal,
    called_program,
    jaxpr_as_fun,
    scan_parts,
    source_info_util,
    while_parts,
)
from pathjax.compile.lanes import flags, runs, slots
from pathjax.compile.lanes.columns import (
    as_components,
    components,
    differs,
    entry,
    gathered,
    is_known_zero,
    join,
    known_zero,
    split,
    with_entry,
)
from pathjax.compile.lanes.dataflow import equation_outputs_differ, variables, variables_read_by
from pathjax.compile.lanes.primitive_rules import COMPONENTWISE, RULES, ZEROS
from pathjax.compile.primitives import basis_p, column_p, compute_once_p, one_by_one_p, together_p

# Most rows of a table from which lanes select; from more rows gathering is faster.
SELECTED_ROWS = 8


class Interpreter:
    """Runs programs on values of `width` lanes."""

    def __init__(self, width: int):
        self.width = width
        # id -> item that is computed once already. Weak, as no tracer may outlive its function.
        self.computed: WeakValueDictionary = WeakValueDictionary()
        self.occupied = None  # (W,) bool lanes that hold an item; None: all
        self.active = None  # (W,) bool lanes whose results are read; None: all. Other lanes may hold anything.

    def run(self, program: ClosedJaxpr, inputs) -> list:
        jaxpr = program.jaxpr
        values = self.initial_values(program, inputs)
        self.run_equations(jaxpr.eqns, values, variables_read_by(jaxpr.eqns) | variables(jaxpr.outvars))
        return [self.read(values, v) for v in jaxpr.outvars]

    def run_for(self, lanes, program: ClosedJaxpr, inputs) -> list:
        """Call `run` with only these lanes (W,) bool active, of those that are active."""
        outer = self.active
        self.active = lanes if outer is None else outer & lanes
        try:
            return self.run(program, inputs)
        finally:
            self.active = outer

    @staticmethod
    def initial_values(program: ClosedJaxpr, inputs) -> dict:
        """Return the values by variable before a program's first equation."""
        jaxpr = program.jaxpr
        return dict(zip([*jaxpr.constvars, *jaxpr.invars], [*program.consts, *inputs], strict=True))

    @staticmethod
    def read(values: dict, atom):
        return atom.val if isinstance(atom, Literal) else values[atom]

    def run_equations(self, eqns, values: dict, used: set | None = None) -> None:
        """Add the results of equations to the values. used: results that are read; None: all."""
        for eqn in eqns:
            wanted = [used is None or v in used for v in eqn.outvars]
            # Operations get the source location of their equation, so that profiles and errors name code of one item.
            with source_info_util.user_context(eqn.source_info.traceback):
                outputs = self.apply(eqn, [self.read(values, v) for v in eqn.invars], wanted)
            values |= zip(eqn.outvars, outputs, strict=True)

    def apply(self, eqn, inputs, used) -> list:
        primitive, name = eqn.primitive, eqn.primitive.name
        if name == "while":
            return self.while_loop(eqn, inputs, used)
        if name == "scan":
            return self.scan(eqn, inputs)
        if name == "cond":
            return self.cond(eqn, inputs)
        if primitive is compute_once_p:
            return self.materialize(inputs)
        if primitive is one_by_one_p:
            return self.one_by_one(inputs, **eqn.params)
        if primitive is together_p:
            return self.together(inputs, **eqn.params)
        if primitive is basis_p:
            return [self.basis(**eqn.params)]
        called = called_program(eqn)
        if called is not None:
            return self.run(called, inputs)
        if not any(map(differs, inputs)):
            outputs = primitive.bind(*inputs, **eqn.params)
            return list(outputs) if primitive.multiple_results else [outputs]
        shape = eqn.outvars[0].aval.shape
        if name in COMPONENTWISE:
            return [self.componentwise(partial(primitive.bind, **eqn.params), inputs, shape, ZEROS.get(name))]
        result = RULES[name](self, inputs, eqn.params, shape) if name in RULES else None
        if result is None:
            return self.by_vmap(eqn, inputs)
        return list(result) if primitive.multiple_results else [result]

    # ---- arithmetic -------------------------------------------------------------------------------------------------

    def columnwise(self, op, *operands):
        """Apply op to operands that are (W,), or () where shared."""
        if any(map(jnp.ndim, operands)):
            operands = [x if jnp.ndim(x) else jnp.broadcast_to(x, (self.width,)) for x in operands]
        return op(*operands)

    def componentwise(self, op, inputs, shape, zeros=None):
        """Apply op to each component; inputs have the shape or are scalars. zeros: a rule of `ZEROS`."""

        def component(*operands):
            known = zeros(*operands) if zeros is not None and any(map(is_known_zero, operands)) else None
            return self.columnwise(op, *operands) if known is None else known

        columns = [np.broadcast_to(components(x), shape).flat for x in inputs]
        return as_components(shape, list(map(component, *columns)))

    @staticmethod
    def basis(count, dtype):
        zero, one = known_zero(dtype), jnp.ones((), dtype)
        return as_components((count, count), [one if i == j else zero for i, j in np.ndindex(count, count)])

    def select(self, which, *cases):
        """Select the components of case number `which`; components that are the same in all cases need no select."""

        def chosen(first, *others):
            same = all(other is first for other in others)
            return first if same else self.columnwise(lax.select_n, which, first, *others)

        columns = (components(case).flat for case in cases)
        return as_components(np.shape(cases[0]), list(map(chosen, *columns)))

    def rows_of_column(self, column, numbers):
        """Return entries (W,) of a shared column (N,): selected from few, kept in registers; gathered from many."""
        if len(column) > SELECTED_ROWS:
            return gathered(column, numbers)
        found = jnp.broadcast_to(column[0], numbers.shape)
        for k in range(1, len(column)):
            found = lax.select(numbers >= k, jnp.broadcast_to(column[k], numbers.shape), found)
        return found

    def materialize(self, values):
        """Return the values, each computed once for all of its consumers; shared values are returned unchanged.

        It works column by column, so that unread columns are eliminated together with their computation.
        """
        items = {id(item): item for value in values if differs(value) for item in value.flat}
        new = [item for item in items.values() if id(item) not in self.computed and not is_known_zero(item)]
        results = list(map(column_p.bind, new))
        items |= zip(map(id, new), results, strict=True)
        self.computed.update((id(item), item) for item in results)
        return [
            as_components(value.shape, [items[id(item)] for item in value.flat]) if differs(value) else value
            for value in values
        ]

    def by_vmap(self, eqn, inputs):
        """Apply any primitive by `jax.vmap`: correct, but slow."""
        joined = [join(x, self.width) if differs(x) else x for x in inputs]
        axes = [0 if differs(x) else None for x in inputs]
        outputs = jax.vmap(partial(eqn.primitive.bind, **eqn.params), in_axes=axes)(*joined)
        return [split(y) for y in (outputs if eqn.primitive.multiple_results else [outputs])]

    def one_by_one(self, inputs, program, search):
        if search is not None:
            return slots.in_slots(self, program, search, inputs)
        rows = [join(x, self.width) if differs(x) else x for x in inputs]
        active = jnp.ones((self.width,), bool) if self.active is None else self.active

        def act(lane, results):
            mine = [entry(row, lane) if differs(x) else x for row, x in zip(rows, inputs, strict=True)]
            return [with_entry(r, y, lane) for r, y in zip(results, jaxpr_as_fun(program)(*mine), strict=True)]

        results = [jnp.zeros((self.width, *aval.shape), aval.dtype) for aval in program.out_avals]
        return list(map(split, flags.for_each_lane(flags.packed(active), act, results)))

    def together(self, inputs, f, shared):
        here = jnp.ones((self.width,), bool) if self.occupied is None else self.occupied
        return f(inputs[:shared], here, [join(x, self.width) for x in inputs[shared:]])

    # ---- control flow -----------------------------------------------------------------------------------------------

    def pack(self, values, differing):
        """Return values as pytrees of arrays, which an XLA loop can carry."""
        return [
            [jnp.broadcast_to(item, (self.width,)) for item in components(value).flat] if differs else value
            for value, differs in zip(values, differing, strict=True)
        ]

    @staticmethod
    def unpack(packed, differing, shapes):
        return [
            as_components(shape, items) if differs else items
            for items, differs, shape in zip(packed, differing, shapes, strict=True)
        ]

    def while_loop(self, eqn, inputs, used):
        test_consts, body_consts, init = while_parts(eqn, inputs)
        test, body = eqn.params["cond_jaxpr"], eqn.params["body_jaxpr"]
        differing = equation_outputs_differ(eqn, list(map(differs, inputs)))
        shapes = [v.aval.shape for v in eqn.outvars]
        # Values that are read later are kept from a lane's last trip; its other values may keep changing.
        tested = variables_read_by(test.jaxpr.eqns) | variables(test.jaxpr.outvars)
        kept = [u or v in tested for u, v in zip(used, test.jaxpr.invars[len(test_consts) :], strict=True)]

        def goes_on(packed):
            (result,) = self.run(test, [*test_consts, *self.unpack(packed, differing, shapes)])
            if not differs(result):
                return result
            return result.item() if self.active is None else result.item() & self.active

        def advance(packed):
            carry = self.unpack(packed, differing, shapes)
            on = goes_on(packed)
            if jnp.ndim(on):
                on = self.materialize([as_components((), [on])])[0].item()
                new = self.run_for(on, body, [*body_consts, *carry])
                pairs = zip(carry, new, kept, strict=True)
                new = [self.select(on, old, value) if keep else value for old, value, keep in pairs]
            else:
                new = self.run(body, [*body_consts, *carry])
            return self.pack(new, differing)

        def any_goes_on(packed):
            on = goes_on(packed)
            return flags.any_set(flags.packed(on)) if jnp.ndim(on) else on

        packed = lax.while_loop(any_goes_on, advance, self.pack(init, differing))
        return self.unpack(packed, differing, shapes)

    def scan(self, eqn, inputs):
        consts, init, xs = scan_parts(eqn, inputs)
        n = len(init)
        differing = equation_outputs_differ(eqn, list(map(differs, inputs)))
        carried, rows = differing[:n], differing[n:]
        shapes = [v.aval.shape for v in eqn.outvars]
        row_shapes = [shape[1:] for shape in shapes[n:]]
        x_differs = list(map(differs, xs))
        x_shapes = [np.shape(x)[1:] for x in xs]

        def step(packed, packed_x):
            carry = self.unpack(packed, carried, shapes[:n])
            x = self.unpack(packed_x, x_differs, x_shapes)
            results = self.run(eqn.params["jaxpr"], [*consts, *carry, *x])
            return self.pack(results[:n], carried), self.pack(results[n:], rows)

        def by_row(x):
            """Turn components (rows, ...) into arrays (rows, W), one for each component of a row."""
            columns = x.reshape(len(x), -1).T
            return [jnp.stack([jnp.broadcast_to(item, (self.width,)) for item in column]) for column in columns]

        packed_xs = [by_row(x) if d else x for x, d in zip(xs, x_differs, strict=True)]
        last, ys = lax.scan(step, self.pack(init, carried), packed_xs, eqn.params["length"], eqn.params["reverse"])
        ys = [
            np.stack([as_components(shape, [item[k] for item in y]) for k in range(eqn.params["length"])]) if d else y
            for y, d, shape in zip(ys, rows, row_shapes, strict=True)
        ]
        return self.unpack(last, carried, shapes[:n]) + ys

    def cond(self, eqn, inputs):
        which, *operands = inputs
        branches = eqn.params["branches"]
        if differs(which):
            which = self.materialize([which])[0].item()
            if runs.pays(self.width, branches):
                number = jnp.clip(which.astype(jnp.int32), 0, len(branches) - 1)
                return runs.in_runs(self, number, branches, operands)
            which = which != 0 if len(branches) == 2 else jnp.clip(which, 0, len(branches) - 1)
            results = [self.run_for(which == k, branch, operands) for k, branch in enumerate(branches)]
            return [self.select(which, *cases) for cases in zip(*results, strict=True)]
        differing = equation_outputs_differ(eqn, list(map(differs, inputs)))
        calls = [lambda branch=branch: self.pack(self.run(branch, operands), differing) for branch in branches]
        return self.unpack(lax.switch(which, calls), differing, [v.aval.shape for v in eqn.outvars])
