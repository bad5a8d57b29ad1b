"""The scene: a pytree of the tables of all rooms, its builder, and its parameters by name."""

from pathjax.scene.builder import build
from pathjax.scene.scene import UNBOUNDED, Scene

__all__ = ["UNBOUNDED", "Scene", "build"]
