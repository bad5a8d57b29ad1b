"""Measurements of `pathjax bench` for one scene.

Half of the timed renders are made before the peer runs and half after, so that a machine that slows down slows both.
Everything but the times is the same in every run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pathjax
from pathjax import distributed
from pathjax.bench import figures, peers, rays
from pathjax.bench.figures import Reference
from pathjax.bench.peers.mitsuba3 import SAMPLERS
from pathjax.derivatives import matrix_free
from pathjax.integrators.options import Options, strategies
from pathjax.rendering.render import render_pixels
from pathjax.scene.parameters import nameless
from pathjax.scene.scene import Scene
from pathjax.sensors import film

# Number of independent images whose mean is the reference; their spread estimates its error.
BATCHES = 16
# Number of images with one sample per pixel, whose error is that of independent random numbers.
SINGLES = 64
# No timed render has these seeds.
REFERENCE_SEED, SINGLES_SEED = 1 << 20, 1 << 21


class Plan(NamedTuple):
    spps: list[int]  # ascending
    repeat: int  # number of timed renders of each kind
    reference_spp: int  # minimum spp of the reference
    against: str | None  # "mitsuba"; None: no peer
    quick: bool  # measure only speed against error
    say: Callable[[str], None]


class Subject(NamedTuple):
    file: str
    defines: dict[str, str]
    scene: Scene
    reference: Reference
    paths: int  # number of paths of a render with one sample per pixel

    def row(self, asked_spp, spp, seconds, images, cpu_seconds=None) -> dict:
        errors = self.reference.errors(images)
        row = figures.row(asked_spp, spp, seconds, errors, self.reference.noise, self.paths, cpu_seconds)
        return {**row, "bias": self.reference.bias(images)}


def measure(file: str, defines: dict[str, str], plan: Plan) -> dict:
    """Measure one scene, and return its entry of the report for `json_text`."""
    say = plan.say
    scene = pathjax.load_scene(file, parameters=defines)
    height, width = film.image_shape(scene.film)
    say(f"{file}: compiling")
    compile_seconds = _compile(scene)
    say(f"{file}: reference, {plan.reference_spp} spp")
    subject = Subject(file, defines, scene, _reference(scene, plan.reference_spp), height * width)
    failures = []

    say(f"{file}: pathjax")
    kinds = {spp: (spp, "mis") for spp in plan.spps}
    before = _timed(scene, kinds, range(plan.repeat // 2))
    peers = []
    if plan.against == "mitsuba":
        for sampler in SAMPLERS:
            say(f"{file}: Mitsuba, {sampler}")
            peers += _mitsuba(subject, sampler, plan, failures)
    after = _timed(scene, kinds, range(plan.repeat // 2, plan.repeat))
    rows = []
    for spp in plan.spps:
        row = subject.row(spp, spp, *(half + rest for half, rest in zip(before[spp], after[spp], strict=True)))
        best = figures.best(peers, spp)
        row["best_peer"] = best and best["sampler"]
        row["best_peer_spp"] = best and best["spp"]  # samplers round up
        row["efficiency_over_best_peer"] = best and row["efficiency"] and row["efficiency"] / best["efficiency"]
        rows.append(row)
    samplers = list(dict.fromkeys(row["sampler"] for row in peers))
    facts = {
        "file": file,
        "width": width,
        "height": height,
        "compile_seconds": compile_seconds,
        "reference_spp": subject.reference.spp,
        "reference_rel_mse": subject.reference.noise,
        "pathjax": rows,
        "mitsuba": peers,
        "slopes": {
            "pathjax": figures.slopes(rows),
            "mitsuba": {name: figures.slopes([r for r in peers if r["sampler"] == name]) for name in samplers},
        },
        "failures": failures,
    }
    unmeasured = "sampler strategies derivatives precision peak_memory_bytes closest_hits rays".split()
    return facts | (dict.fromkeys(unmeasured) if plan.quick else _more(subject, rows, plan, failures))


def _more(subject: Subject, rows, plan: Plan, failures) -> dict:
    """Return the measurements that `--quick` leaves out."""
    say, file = plan.say, subject.file
    say(f"{file}: independent numbers")
    sampler = _sampler(subject, rows)
    say(f"{file}: strategies")
    strategies = _strategies(subject, plan)
    say(f"{file}: derivatives")
    more = {"sampler": sampler, "strategies": strategies, "derivatives": _derivatives(subject.scene, plan)}
    if distributed.index() > 0:  # only the first process does the rest
        return more
    say(f"{file}: float32 and float64")
    precision, memory = _precision(subject, plan, failures)
    say(f"{file}: closest hits")
    closest_hits, beside_embree = rays.rates(subject.scene, plan.repeat)
    return more | {
        "precision": precision,
        "peak_memory_bytes": memory,
        "closest_hits": closest_hits,
        "rays": beside_embree,
    }


def _compile(scene: Scene) -> float:
    """Return the seconds by which a first render takes longer than a second, with empty compilation caches."""
    jax.clear_caches()
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        jax.block_until_ready(pathjax.render(scene, spp=1))
        seconds.append(time.perf_counter() - started)
    return seconds[0] - seconds[1]


def _reference(scene: Scene, spp: int) -> Reference:
    batches = max(2, min(BATCHES, spp))
    each = -(-spp // batches)
    images = (pathjax.render(scene, each, REFERENCE_SEED + k) for k in range(batches))
    return figures.reference_of(images, each)


def _timed(scene: Scene, kinds: dict, seeds) -> dict:
    """Return seconds, images and CPU seconds of every kind {name: (spp, strategy)}, one per seed; kinds alternate."""
    done = {name: ([], [], []) for name in kinds}
    for seed in seeds:
        for name, (spp, strategy) in kinds.items():
            started, worked = time.perf_counter(), time.process_time()
            image = np.asarray(pathjax.render(scene, spp, seed, strategy))
            seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - worked
            result = seconds, image, distributed.total(cpu_seconds)
            for values, value in zip(done[name], result, strict=True):
                values.append(value)
    return done


def _mitsuba(subject: Subject, sampler: str, plan: Plan, failures) -> list[dict]:
    """Return the rows of one of Mitsuba's samplers; if it cannot render, return none and append to `failures` why."""
    seeds = list(range(1, plan.repeat + 1))
    runs = [{"sampler": sampler, "spp": spp, "seeds": seeds} for spp in plan.spps]
    try:
        report, arrays = peers.call("mitsuba3", {"scene": subject.file, "parameters": subject.defines, "runs": runs})
    except (peers.PeerMissing, peers.RequestError, peers.PeerFailed) as error:
        failures.append(f"Mitsuba, {sampler}: {error}")
        return []
    rows = []
    for k, (asked, done) in enumerate(zip(runs, report["runs"], strict=True)):
        images = arrays[f"images_{k}"][..., :3]
        row = subject.row(asked["spp"], done["spp"], done["seconds"], images, done["cpu_seconds"])
        rows.append({"sampler": sampler, "program": report["program"], **row})
    return rows


def _sampler(subject: Subject, rows) -> dict:
    """Compare pathjax's sampler with independent numbers, whose relMSE at N samples is that of single samples over N.

    A single sample uses independent uniform numbers, however it is correlated with the next sample.
    """
    scene, reference = subject.scene, subject.reference
    images = (pathjax.render(scene, 1, SINGLES_SEED + k) for k in range(SINGLES))
    errors = reference.errors(images)
    single = float(np.mean(errors)) - reference.noise
    compared = []
    for row in rows:
        independent = single / row["spp"]
        ratio = independent / row["rel_mse"] if row["efficiency"] else None
        compared.append(
            {
                "spp": row["spp"],
                "rel_mse": row["rel_mse"],
                "independent_rel_mse": independent,
                "ratio": ratio,
            }
        )
    return {
        "single_rel_mse": single,
        "single_rel_mse_standard_error": figures.standard_error(errors),
        "rows": compared,
    }


def _middle(spps: list[int]) -> int:
    return spps[len(spps) // 2]


def _strategies(subject: Subject, plan: Plan) -> list[dict]:
    spp, possible = _middle(plan.spps), strategies(subject.scene)
    for strategy in possible:
        jax.block_until_ready(pathjax.render(subject.scene, 1, strategy=strategy))
    done = _timed(subject.scene, {strategy: (spp, strategy) for strategy in possible}, range(plan.repeat))
    return [{"strategy": strategy, **subject.row(spp, spp, *done[strategy])} for strategy in possible]


def _derivatives(scene: Scene, plan: Plan) -> dict | None:
    """Return CPU seconds of J v, J^T v and the image, alternating, in all parameters that the recorded sweep handles.

    None if there is no such parameter.
    """
    spp, parameters = _middle(plan.spps), scene.described.parameters
    wanted = {name: each for name, each in parameters.items() if matrix_free.is_swept(scene, each)}
    if not wanted:
        return None
    v = {name: jnp.ones(each.shape, scene.camera.origin.dtype) for name, each in wanted.items()}
    pixels = film.pixels(film.with_own_samples(scene.film))
    adjoint, options, scene = jnp.ones((len(pixels), 3), scene.camera.origin.dtype), Options(), nameless(scene)
    calls = {
        "image": lambda seed: render_pixels(scene, pixels, 0, spp, seed),
        "J v": lambda seed: matrix_free.push(scene, wanted, v, pixels, 0, spp, seed, options),
        "J^T v": lambda seed: matrix_free.pull(scene, wanted, adjoint, pixels, 0, spp, seed, options),
    }
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for seed in range(1 + plan.repeat):
        for name, call in calls.items():
            started = time.process_time()
            jax.block_until_ready(call(seed))
            seconds[name].append(distributed.total(time.process_time() - started))
    # The first call of each compiles.
    numbers = sum(math.prod(each.shape) for each in wanted.values())
    return {"spp": spp, "numbers": numbers, "cpu_seconds": {name: each[1:] for name, each in seconds.items()}}


def _precision(subject: Subject, plan: Plan, failures) -> tuple[dict | None, int | None]:
    """Compare the same seeds in float32 and float64, and return peak memory in float32; None if a process failed."""
    spp, seeds = _middle(plan.spps), list(range(plan.repeat))
    request = {"scene": subject.file, "parameters": subject.defines, "spp": spp, "seeds": seeds}
    done = {}
    for dtype in ("float32", "float64"):
        try:
            report, arrays = peers.call("pathjax_alone", {**request, "dtype": dtype})
            done[dtype] = report, arrays["images"]
        except peers.PeerFailed as error:
            failures.append(f"{dtype}: {error}")
    memory = done["float32"][0]["peak_memory_bytes"] if "float32" in done else None
    if len(done) < 2:
        return None, memory
    rows = {dtype: subject.row(spp, spp, report["seconds"], images) for dtype, (report, images) in done.items()}
    return {**rows, **figures.deviation(done["float32"][1], done["float64"][1])}, memory
