"""Kinds, and objects of a kind as files describe them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from pathjax.errors import InputError
from pathjax.kinds.declared import Declared, Setting, Unused
from pathjax.kinds.parameter import Parameter, Parameters
from pathjax.kinds.table import Column, Table


@dataclass(frozen=True, eq=False)
class Instance:
    """One object of a kind, as a file describes it. Compared by identity: a shared object is one row."""

    kind: type[Kind]
    name: str  # id, the first part of its parameters' names
    values: Mapping[str, object]  # of declared parameters: numbers, arrays, instances of textures, None


class Stored(ABC):
    """A value that is an array in a file of its own."""

    data: np.ndarray

    @abstractmethod
    def write(self, path: Path, data: np.ndarray) -> None:
        """Write these values to a file of the same format as the value's own."""


class Kind:
    """A class whose attributes of type `Declared` are the parameters of a kind."""

    declared: ClassVar[Mapping[str, Declared]] = {}
    unused: ClassVar[Mapping[str, Unused]] = {}  # parameters that files may give, without effect
    fills_places: ClassVar[bool] = False  # objects of it replace parameters, as textures do

    def __init_subclass__(cls):
        classes = [vars(each) for each in reversed(cls.__mro__)]
        cls.declared = {key: d for each in classes for key, d in each.items() if isinstance(d, Declared)}
        cls._places = {name: place for place, name in enumerate(cls.declared)}

    @classmethod
    def place(cls, name: str) -> int:
        """Return the index of a declared parameter's column in the table."""
        return cls._places[name]

    @classmethod
    def read(cls, loader, fields, name: str, **known) -> Instance:
        """Read one object of this kind from a scene file.

        Args:
            loader: loader of scene files: `loader.texture(fields, parameter, owner)`, `loader.notes`, ...
            fields: `description.fields.Fields`, which refuses parameters that nothing reads.
            name: first part of its parameters' names.
            known: values of parameters that are not to be read.
        """
        asked = {key: d for key, d in cls.declared.items() if key not in known}
        values = {key: d.read(loader, fields, key, name) for key, d in asked.items()}
        for key, d in asked.items():
            if d.required and values[key] is None:
                or_texture = ", or a texture of that name" if d.textured else ""
                raise fields.lacks(d.tag, key, or_texture)
        return cls.instance(name, **known, **values)

    @classmethod
    def instance(cls, name: str = "", **values) -> Instance:
        """Return an object of this kind without a file; parameters that are not given have their defaults."""
        unknown = sorted(values.keys() - cls.declared.keys())
        if unknown:
            raise InputError(f"{cls.__name__} has no parameter {unknown[0]!r}; it has {', '.join(cls.declared)}")
        return Instance(cls, name, {key: values.get(key, d.default) for key, d in cls.declared.items()})

    @classmethod
    def variant(cls, instance: Instance) -> tuple:
        """Return the values that all rows of a table must share, for which its program is compiled."""
        return tuple(instance.values[key] for key, d in cls.declared.items() if isinstance(d, Setting))

    @classmethod
    def build(
        cls, instances: list[Instance], dtype, path: tuple, parameters: Parameters, code: Callable | None
    ) -> Table:
        """Build the table of instances of the same `variant`.

        Args:
            path: where the table will be in the scene.
            parameters: the rows' parameters are entered here.
            code: instance of a texture -> its kind and row among the textures; None: nothing is textured.
        """
        columns = [
            _column(declared, [instance.values[key] for instance in instances], dtype, code)
            for key, declared in cls.declared.items()
        ]
        for row, instance in enumerate(instances):
            for place, (key, declared) in enumerate(cls.declared.items()):
                name, value = f"{instance.name}.{key}", instance.values[key]
                if isinstance(value, Instance):
                    parameters.enter_texture(name, value, declared, None if cls.fills_places else key)
                elif value is not None and declared.listed:
                    where = (*path, "columns", place, "values"), (row,)
                    how = declared.shape, declared.bounds, key, declared.moves_paths, declared.least
                    parameters.known[name] = Parameter(*where, *how)
        settings = tuple((key, instances[0].values[key]) for key, d in cls.declared.items() if isinstance(d, Setting))
        return cls.derived(Table(tuple(columns), cls, settings))

    @classmethod
    def derived(cls, table: Table, changed: Collection[str] = ()) -> Table:
        """Return the table with its derived columns up to date; called when a table is built or its parameters change.

        changed: names of the columns that have changed; empty for a table that is built.
        """
        return table


def _column(declared: Declared, values: list, dtype, code: Callable | None) -> Column | None:
    """Return the column of one parameter; None: no row has it, or it is a setting or shared."""
    if isinstance(declared, Setting) or declared.shared or all(value is None for value in values):
        return None
    textured = [isinstance(value, Instance) for value in values]
    missing = [value is None or is_texture for value, is_texture in zip(values, textured, strict=True)]
    constants = [
        np.broadcast_to(declared.absent if is_missing else value, declared.shape)
        for value, is_missing in zip(values, missing, strict=True)
    ]
    codes = [code(value) if is_texture else (-1, 0) for value, is_texture in zip(values, textured, strict=True)]
    stacked = np.asarray(np.stack(constants), declared.dtype or dtype)
    return Column(stacked, np.array(codes, np.int32) if any(textured) else None)


def ordered(instances, kinds: Mapping[str, type]) -> dict[type, list[Instance]]:
    """Group instances by kind. Scenes of the same kinds share a structure, whatever the order in the file."""
    known = list(kinds.values())
    by_kind: dict[type, list[Instance]] = {}
    for each in sorted(instances, key=lambda each: known.index(each.kind) if each.kind in known else len(known)):
        by_kind.setdefault(each.kind, []).append(each)
    return by_kind


def register(kinds: dict[str, type], base: type, name: str, room: str, fault: Callable = lambda kind: ""):
    """Return a decorator that adds a class to the kinds of a room, so that scene files can name it.

    Args:
        fault: class -> message why the room cannot use it; empty: it can.
    Raises:
        InputError: the name is taken by another class, the class is not derived from `base`, or it has a fault.
    """

    def enter(cls):
        if not (isinstance(cls, type) and issubclass(cls, base)):
            raise InputError(f"{room}.register({name!r}): {cls!r} must be a class derived from {room}.{base.__name__}")
        if why := fault(cls):
            raise InputError(f"{room}.register({name!r}): {cls.__qualname__} {why}")
        known = kinds.get(name)
        # A notebook cell that runs again defines its class again.
        if known and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise InputError(f"{room}.register({name!r}): the name is taken by {known.__qualname__}; use another one")
        kinds[name] = cls
        return cls

    return enter
