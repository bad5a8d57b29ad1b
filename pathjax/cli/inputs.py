"""Inputs of commands: scenes, with their parameters set, and numbers."""

from __future__ import annotations

from functools import partial

from pathjax import distributed
from pathjax.compile import keep_kernels
from pathjax.errors import InputError
from pathjax.io.mitsuba import loader
from pathjax.scene.builder import build
from pathjax.scene.parameters import with_parameters
from pathjax.scene.scene import Scene
from pathjax.system.interrupts import wait_for


def load(options) -> Scene:
    """Load the scene of a command, with its `-D` and `--set`. Do not warn if the scene is dark."""
    return wait_for(lambda: _load(options))


def _load(options) -> Scene:
    keep_kernels()
    read = partial(loader.load, options.scene, options.sensor, **dict(options.defines))
    scene = build(distributed.of_file(options.scene, read))
    return with_parameters(scene, {name: numbers("--set", name, text) for name, text in options.settings})


def numbers(option: str, name: str, text: str) -> float | list[float]:
    """Parse the value of `option NAME=text`: one number, or several separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} {name}={text}: a value is a number, or three separated by commas") from None
    return values[0] if len(values) == 1 else values
