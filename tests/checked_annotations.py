"""A package whose annotations are checked while it runs: arguments, results and records, in types, shapes and dtypes.

    python tests/checked_annotations.py [--no-fit] SCENE...

traces images of the scenes and their derivatives, for shapes are known by then, and fits to the first one; with
--no-fit nothing is compiled. The first annotation that does not hold ends it with a TypeError.
"""

from __future__ import annotations

import dataclasses
import gc
import importlib
import inspect
import pkgutil
import sys
import typing
from functools import wraps
from pathlib import Path

import beartype
import jaxtyping
import numpy as np
from beartype.door import is_bearable

# An int may stand for a float, as type checkers have it.
CONF = beartype.BeartypeConf(is_pep484_tower=True)


def check_function(function):
    """What jaxtyping applies to each function; of records, `check_record` looks after what makes them."""
    return function if function.__name__ == "__init__" else beartype.beartype(conf=CONF)(function)


def check_record(record: type, package: str) -> None:
    """Check the fields of a NamedTuple or dataclass wherever the package itself makes one.

    Not where JAX makes one of leaves, which may be batches or no arrays at all.
    """
    name = "__new__" if issubclass(record, tuple) else "__init__"
    make, hints = getattr(record, name), typing.get_type_hints(record)
    signature = inspect.signature(make)

    @wraps(make)
    def checked(*args, **kwargs):
        if sys._getframe(1).f_globals["__name__"].split(".")[0] == package:
            _, *fields = signature.bind(*args, **kwargs).arguments.items()
            with jaxtyping.jaxtyped("context"):
                for field, value in fields:
                    if not holds(value, hints[field]):
                        raise TypeError(f"{record.__qualname__}.{field} = {value!r} is no {hints[field]}")
        return make(*args, **kwargs)

    setattr(record, name, checked)


def holds(value, hint) -> bool:
    """Whether a field is what it should be. A NumPy array is as good as one of JAX: tables are filled with them."""
    if is_bearable(value, hint, conf=CONF):
        return True
    import jax.numpy as jnp

    return isinstance(value, np.ndarray | np.generic) and is_bearable(jnp.asarray(value), hint, conf=CONF)


def load(package: str):
    """Import all modules of a package with their annotations checked."""
    sys.modules.setdefault("checked_annotations", sys.modules[__name__])
    with jaxtyping.install_import_hook(package, "checked_annotations.check_function"):
        loaded = importlib.import_module(package)
        for _, name, _ in pkgutil.walk_packages(loaded.__path__, f"{package}."):
            importlib.import_module(name)
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        for kind in list(vars(sys.modules[name]).values()):
            if inspect.isclass(kind) and kind.__module__ == name:
                if dataclasses.is_dataclass(kind) or hasattr(kind, "_fields"):
                    check_record(kind, package)
    return loaded


def trace(pj, file: Path) -> None:
    """Trace a scene's image, the derivatives in all its parameters, and what else is asked of a scene."""
    import jax
    import jax.numpy as jnp

    scene = pj.load_scene(file, res=4)
    jax.eval_shape(lambda scene: pj.render(scene, spp=1), scene)
    # A Jacobian has no textures.
    names = [name for name, parameter in scene.about.parameters.items() if not parameter.is_texture]
    jax.eval_shape(lambda scene: tuple(pj.jacobian(scene, names, spp=1)), scene)
    jax.eval_shape(lambda scene: pj.render_bounces(scene, depth=2, spp=4), scene)
    jax.eval_shape(lambda scene: pj.closest_hit(scene, jnp.zeros((2, 3)), jnp.ones((2, 3))), scene)


def fit(pj, file: Path) -> None:
    scene = pj.load_scene(file, res=4)
    pj.render_aovs(scene, ["depth", "normal", "albedo"], spp=1)
    target = pj.render(scene, spp=4, seed=1)
    pj.fit(scene, target, list(pj.parameters(scene))[:1], spp=4)


if __name__ == "__main__":
    gc.set_threshold(50_000, 20, 50)  # most objects stay: to look for garbage as often as Python does takes long
    package, paths = load("pathjax"), [Path(name) for name in sys.argv[1:] if name != "--no-fit"]
    for path in paths:
        trace(package, path)
    if "--no-fit" not in sys.argv:
        fit(package, paths[0])
