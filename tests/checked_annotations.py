"""Run a package with its annotations checked: types, shapes and dtypes of arguments, results and record fields.

    python tests/checked_annotations.py [--no-fit] SCENE...

traces images of the scenes and their derivatives, since tracing already knows all shapes, and fits to the first scene;
with --no-fit nothing is compiled. The first annotation that does not hold ends the run with a TypeError.
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

# As in type checkers, an int is accepted for a float.
CONF = beartype.BeartypeConf(is_pep484_tower=True)


def check_function(function):
    """Type-check a function; jaxtyping applies this to each one. `check_record` checks the constructors of records."""
    return function if function.__name__ == "__init__" else beartype.beartype(conf=CONF)(function)


def check_record(record: type, package: str) -> None:
    """Check the fields of a NamedTuple or dataclass wherever the package itself constructs one.

    Records that JAX rebuilds from leaves are not checked: the leaves may be batched or no arrays at all.
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
    """Return whether a value fits its field's annotation. NumPy arrays, which fill tables, count as JAX arrays."""
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
    """Trace a scene's image, its terms by depth, a query, and the derivatives in all parameters but textures."""
    import jax
    import jax.numpy as jnp

    scene = pj.load_scene(file, res=4)
    jax.eval_shape(lambda scene: pj.render(scene, spp=1), scene)
    # `jacobian` takes no textures.
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
    gc.set_threshold(50_000, 20, 50)  # most objects live on: frequent garbage collection is slow
    package, paths = load("pathjax"), [Path(name) for name in sys.argv[1:] if name != "--no-fit"]
    for path in paths:
        trace(package, path)
    if "--no-fit" not in sys.argv:
        fit(package, paths[0])
