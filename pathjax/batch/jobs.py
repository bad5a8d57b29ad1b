"""Jobs of a batch: one per line, checked before anything is rendered."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from pathjax.description.elements import nearest
from pathjax.errors import InputError
from pathjax.integrators.options import Options, check_counts


@dataclass(frozen=True)
class Job:
    """One image. All fields but the last are keys of a line of a jobs file."""

    scene: str | os.PathLike  # a scene file, glTF or a mesh; relative to the jobs file
    output: str | os.PathLike  # .exr or .png; relative to the folder of the batch
    parameters: Mapping[str, object] = field(default_factory=dict)  # values of the file's `$parameters`
    set: Mapping[str, object] = field(default_factory=dict)  # values of the scene's parameters
    sensor: int | str = 0
    spp: int | None = None  # default: the file's, if neither `error` nor `time` is given
    error: float | None = None
    time: float | None = None
    seed: int = 0
    strategy: str = "mis"
    place: str = ""  # file and line of the job, or its index, for messages


KEYS = tuple(f.name for f in fields(Job))[:-1]


def read(file: str | os.PathLike, folder: str | os.PathLike) -> list[Job]:
    """Read the jobs of a JSON Lines file: one object with the fields of `Job` per line; empty lines are skipped.

    folder: folder of the outputs.
    Raises:
        InputError: the file cannot be read, a line is not a job, or two jobs have the same output; names file and line.
    """
    file = Path(file)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is not UTF-8"
        raise InputError(f"{file}: the jobs cannot be read: {why}") from None
    # Not `splitlines`, which also splits at U+2028 within strings.
    numbered = ((f"{file}:{number}", line) for number, line in enumerate(text.split("\n"), 1) if line.strip())
    return checked(((place, _decoded(place, line)) for place, line in numbered), folder)


def checked(numbered: Iterable[tuple[str, object]], folder: str | os.PathLike) -> list[Job]:
    """Return the jobs of pairs (place, mapping with the fields of `Job`). folder: folder of the outputs.

    Raises:
        InputError: a mapping is not a job, two jobs have the same output, or there is no job.
    """
    jobs = [_job(place, values) for place, values in numbered]
    if not jobs:
        raise InputError("the batch is empty; give at least one job, such as " + _EXAMPLE)
    first: dict[str, Job] = {}
    for job in jobs:
        other = first.setdefault(os.path.abspath(os.path.join(folder, job.output)), job)
        if other is not job:
            raise InputError(f"{job.place}: {job.output} is the output of {other.place} too; give each its own")
    return jobs


_EXAMPLE = '{"scene": "box.xml", "output": "box.exr", "spp": 16}'


def _decoded(place: str, line: str) -> object:
    try:
        return json.loads(line)
    except json.JSONDecodeError as error:
        raise InputError(f"{place}: column {error.colno}: {error.msg}; a job is one JSON object: {_EXAMPLE}") from None


def _job(place: str, values: object) -> Job:
    if not isinstance(values, Mapping):
        raise InputError(f"{place}: a job is one JSON object or mapping, such as {_EXAMPLE}, not {str(values)[:40]}")
    for key in values:
        if key not in KEYS:
            raise InputError(f'{place}: a job has no "{key}"{nearest(key, KEYS)}; its keys are {", ".join(KEYS)}')
    for key in ("scene", "output"):
        if not isinstance(values.get(key), str | os.PathLike) or not str(values[key]):
            raise InputError(f'{place}: a job needs "{key}", the name of a file; for instance {_EXAMPLE}')
    for key in ("parameters", "set"):
        if not isinstance(values.get(key, {}), Mapping):
            raise InputError(f'{place}: "{key}" = {values[key]!r}; it is an object of names and values')
    job = Job(**values, place=place)
    if Path(job.output).suffix.lower() not in (".exr", ".png"):
        raise InputError(f"{place}: {job.output}: images are written as .exr or .png")
    for key in ("error", "time"):
        value = values.get(key)
        if value is not None and (type(value) not in (int, float) or not 0 < value < math.inf):
            raise InputError(f'{place}: "{key}" = {value!r}; it is a positive number')
    try:
        check_counts(1 if job.spp is None else job.spp, job.seed)
        Options(job.strategy)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    return job
