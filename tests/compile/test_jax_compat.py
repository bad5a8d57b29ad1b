"""Behaviour of JAX that differs between versions or is surprising."""

from dataclasses import dataclass, field, make_dataclass

import jax
import pytest

from pathjax.compile import register_dataclass


@register_dataclass
@dataclass(frozen=True)
class Ball:
    centre: float
    radius: float
    name: str = field(default="ball", metadata={"static": True})


def test_fields_of_a_dataclass_are_children_but_the_static_ones():
    ball = Ball(1.0, 2.0, "a")
    assert jax.tree.leaves(ball) == [1.0, 2.0]
    assert jax.tree.map(lambda x: x + 1, ball) == Ball(2.0, 3.0, "a")
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(ball)]
    assert paths == [".centre", ".radius"]
    assert jax.tree.structure(ball) == jax.tree.structure(Ball(3.0, 4.0, "a"))
    assert jax.tree.structure(ball) != jax.tree.structure(Ball(1.0, 2.0, "b"))


def test_each_class_of_the_same_fields_gets_a_kernel_of_its_own():
    """A hundred classes, since a hash table confuses two only where some bits of their hashes agree."""

    @jax.jit
    def number_of(x):
        return x.x + type(x).number

    for number in range(100):
        cls = make_dataclass("Same", ["x"], namespace={"number": number}, frozen=True)
        assert number_of(register_dataclass(cls)(0)) == number


if __name__ == "__main__":
    pytest.main([__file__])
