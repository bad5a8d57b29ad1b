"""All that pathjax uses of JAX beyond its public interface, and what differs between JAX's versions.

Tested with jax 0.7.2 to 0.12: a new version is met here.
"""

from __future__ import annotations

import os
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import jax
from jax.custom_derivatives import SymbolicZero
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func as func_dialect

__all__ = [
    "ClosedJaxpr",
    "Literal",
    "Primitive",
    "ad",
    "aval_of",
    "batching",
    "bytes_of_program",
    "call_of_identity",
    "called_program",
    "found_cluster",
    "gathered",
    "is_symbolic_zero",
    "is_traced",
    "jaxpr_as_fun",
    "mlir",
    "program_of",
    "program_of_bytes",
    "register_dataclass",
    "scan_parts",
    "source_info_util",
    "while_parts",
]

# Primitives that only call a program of other primitives, and the parameter that holds it.
_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",  # until jax 0.8
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
}
Class = TypeVar("Class", bound=type)
func: Any = func_dialect  # its annotations leave out what its classes inherit


def register_dataclass(cls: Class) -> Class:
    """What `jax.tree_util.register_dataclass` does: a pytree whose fields are children, but the static ones.

    There, structures of two dataclasses with equal fields are equal since JAX 0.8. Their hashes differ, but tables of
    hashes compare seven bits of them: one pair in 128 shares a kernel, and disks are searched as rectangles.
    """
    static = [f.name for f in fields(cls) if f.metadata.get("static")]
    data = [f.name for f in fields(cls) if f.name not in static]
    keys = [jax.tree_util.GetAttrKey(name) for name in data]

    def flatten(x):
        return [getattr(x, name) for name in data], tuple(getattr(x, name) for name in static)

    def flatten_with_keys(x):
        children, about = flatten(x)
        return list(zip(keys, children, strict=True)), about

    def unflatten(about, children):
        x = object.__new__(cls)  # unchecked, as JAX puts other things in the place of arrays
        for name, value in zip(data + static, (*children, *about), strict=True):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def aval_of(shape: tuple[int, ...], dtype):
    """What a primitive says of an array that it gives."""
    return jax.core.ShapedArray(shape, dtype)


def is_traced(x) -> bool:
    """Whether x stands for a value that is not known yet, within `jax.jit` or a transformation."""
    return isinstance(x, jax.core.Tracer)


def is_symbolic_zero(x) -> bool:
    """Whether x is what `custom_jvp(symbolic_zeros=True)` gives for a tangent that is zero."""
    return isinstance(x, SymbolicZero)


def program_of(f, *args) -> tuple[ClosedJaxpr, list]:
    """A function of flat arguments as a program without constants, and what it closes over, its first inputs."""
    traced = jax.make_jaxpr(f)(*args)
    consts = traced.consts

    def closed(*inputs):
        return jax.core.eval_jaxpr(traced.jaxpr, inputs[: len(consts)], *inputs[len(consts) :])

    return jax.make_jaxpr(closed)(*consts, *args) if consts else traced, consts


def called_program(eqn) -> ClosedJaxpr | None:
    """What an equation calls, if calling a program is all that it does."""
    name = eqn.primitive.name
    if name == "call_hi_primitive":  # jax 0.12: what it writes in other primitives
        return jax.make_jaxpr(partial(eqn.primitive.to_lojax, **eqn.params))(*(v.aval for v in eqn.invars))
    if name not in _CALLS:
        return None
    program = eqn.params[_CALLS[name]]
    return program if hasattr(program, "consts") else ClosedJaxpr(program, ())


def call_of_identity(context: mlir.LoweringRuleContext, value: ir.Value) -> list[ir.Value]:
    """Lower a value to what a function gives back, which XLA keeps as a call: no fusion reaches across it."""
    module, types = context.module_context, [value.type]
    start = ir.InsertionPoint.at_block_begin(module.module.body)
    function = func.FuncOp("identity", (types, types), visibility="private", ip=start)
    module.symbol_table.insert(function)
    with ir.InsertionPoint(function.add_entry_block()):
        func.ReturnOp(list(function.arguments))
    call = func.CallOp(types, ir.FlatSymbolRefAttr.get(function.name.value), [value])
    call.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get({"inlineable": ir.StringAttr.get("false")})
    return list(call.results)


def bytes_of_program(compiled) -> bytes:
    """A compiled function of one device as bytes."""
    from jax.experimental.serialize_executable import serialize

    return serialize(compiled)[0]


def program_of_bytes(content: bytes, arguments, result):
    """The compiled function of such bytes, as it was called: a tuple of arguments, and something like its result."""
    from jax.experimental.serialize_executable import deserialize_and_load

    trees = jax.tree.structure((arguments, {})), jax.tree.structure(result)
    return deserialize_and_load(content, *trees, execution_devices=jax.local_devices()[:1])


def while_parts(eqn, values) -> tuple[list, list, list]:
    """Values of a while loop: constants of the test, of the body, what is carried."""
    n, m = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    return values[:n], values[n : n + m], values[n + m :]


def scan_parts(eqn, values) -> tuple[list, list, list]:
    """Values of a scan: constants, what is carried, what is taken row by row."""
    if "num_consts" in eqn.params:
        n, m = eqn.params["num_consts"], eqn.params["num_carry"]
    else:  # jax 0.12
        n, m, _ = (len(tree.vals) for tree in eqn.params["ft_in"].unpack())
    return values[:n], values[n : n + m], values[n + m :]


def gathered(tree):
    """What all processes give: a tree of arrays (processes, ...)."""
    from jax.experimental import multihost_utils  # takes a moment, and one process never needs it

    return multihost_utils.process_allgather(tree)


def found_cluster(seconds: int) -> tuple[Any, Any, Any, Any]:
    """What `jax.distributed.initialize` finds out by itself: address, processes, number of this one, its devices.

    None: it does not know.
    """
    from jax._src.clusters import ClusterEnv

    address = os.environ.get("JAX_COORDINATOR_ADDRESS")
    return ClusterEnv.auto_detect_unset_distributed_params(address, None, None, None, None, seconds)
