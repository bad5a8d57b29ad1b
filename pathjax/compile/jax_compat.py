"""Everything that pathjax uses of JAX beyond its public interface, and the differences between JAX's versions.

Tested with jax 0.7.2 to 0.12. Adaptations to a new version belong here.
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

# Primitives that only call another program -> the parameter that holds that program.
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
func: Any = func_dialect  # its annotations omit inherited members


def register_dataclass(cls: Class) -> Class:
    """Register a dataclass as a pytree whose non-static fields are children, like `jax.tree_util.register_dataclass`.

    With JAX's function, since JAX 0.8, tree structures of two dataclasses with equal fields compare equal. Their hashes
    differ, but hash tables compare seven bits of them: one pair in 128 shares a kernel, and disks are intersected as
    rectangles.
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
        x = object.__new__(cls)  # without checks, as JAX puts other objects in place of arrays
        for name, value in zip(data + static, (*children, *about), strict=True):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def aval_of(shape: tuple[int, ...], dtype):
    """Return the abstract value of a primitive's result."""
    return jax.core.ShapedArray(shape, dtype)


def is_traced(x) -> bool:
    """Return whether x is a tracer, of `jax.jit` or another transformation."""
    return isinstance(x, jax.core.Tracer)


def is_symbolic_zero(x) -> bool:
    """Return whether x is the zero tangent that `custom_jvp(symbolic_zeros=True)` passes."""
    return isinstance(x, SymbolicZero)


def program_of(f, *args) -> tuple[ClosedJaxpr, list]:
    """Trace a function of flat arguments.

    Returns:
        The program, without constants, and the arrays that the function closes over, which are its first inputs.
    """
    traced = jax.make_jaxpr(f)(*args)
    consts = traced.consts

    def closed(*inputs):
        return jax.core.eval_jaxpr(traced.jaxpr, inputs[: len(consts)], *inputs[len(consts) :])

    return jax.make_jaxpr(closed)(*consts, *args) if consts else traced, consts


def called_program(eqn) -> ClosedJaxpr | None:
    """Return the program that an equation calls; None: the equation is not a plain call."""
    name = eqn.primitive.name
    if name == "call_hi_primitive":  # jax 0.12: defined by other primitives
        return jax.make_jaxpr(partial(eqn.primitive.to_lojax, **eqn.params))(*(v.aval for v in eqn.invars))
    if name not in _CALLS:
        return None
    program = eqn.params[_CALLS[name]]
    return program if hasattr(program, "consts") else ClosedJaxpr(program, ())


def call_of_identity(context: mlir.LoweringRuleContext, value: ir.Value) -> list[ir.Value]:
    """Lower a value to a call of the identity that XLA does not inline, so that nothing is fused across it."""
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
    """Serialise a compiled function of one device."""
    from jax.experimental.serialize_executable import serialize

    return serialize(compiled)[0]


def program_of_bytes(content: bytes, arguments, result):
    """Load a function from the bytes of `bytes_of_program`.

    Args:
        content: the bytes.
        arguments: tuple of arguments of the same tree structure as when it was compiled.
        result: a pytree of its result's structure.
    """
    from jax.experimental.serialize_executable import deserialize_and_load

    trees = jax.tree.structure((arguments, {})), jax.tree.structure(result)
    return deserialize_and_load(content, *trees, execution_devices=jax.local_devices()[:1])


def while_parts(eqn, values) -> tuple[list, list, list]:
    """Split the values of a while loop into constants of the test, constants of the body, and carry."""
    n, m = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    return values[:n], values[n : n + m], values[n + m :]


def scan_parts(eqn, values) -> tuple[list, list, list]:
    """Split the values of a scan into constants, carry, and arrays that are scanned over."""
    if "num_consts" in eqn.params:
        n, m = eqn.params["num_consts"], eqn.params["num_carry"]
    else:  # jax 0.12
        n, m, _ = (len(tree.vals) for tree in eqn.params["ft_in"].unpack())
    return values[:n], values[n : n + m], values[n + m :]


def gathered(tree):
    """Gather a pytree of arrays from all processes, each as (processes, ...)."""
    from jax.experimental import multihost_utils  # slow to import, and a single process does not need it

    return multihost_utils.process_allgather(tree)


def found_cluster(seconds: int) -> tuple[Any, Any, Any, Any]:
    """Return the settings that `jax.distributed.initialize` detects; None: one that it cannot detect.

    Returns:
        address, number of processes, index of this process, its devices.
    """
    from jax._src.clusters import ClusterEnv

    address = os.environ.get("JAX_COORDINATOR_ADDRESS")
    return ClusterEnv.auto_detect_unset_distributed_params(address, None, None, None, None, seconds)
