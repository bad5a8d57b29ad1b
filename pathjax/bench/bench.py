"""`pathjax bench`: compile seconds, run seconds, error and efficiency for several spp, and ray rates, beside a peer.

Efficiency is 1 / (relMSE x seconds), relMSE against a converged reference of pathjax's own with another seed. Times
are medians; half of ours are taken before the peer runs and half after, so that a machine that slows down slows both.
"""

from __future__ import annotations

import json
import platform
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import pathjax
from pathjax import film
from pathjax.bench import embree_peer, mitsuba_peer
from pathjax.camera import sample_ray
from pathjax.core.warp import square_to_sphere
from pathjax.errors import InputError
from pathjax.estimate import RELATIVE_FLOOR
from pathjax.io.files import write_text
from pathjax.query import _closest_hit
from pathjax.shapes.triangle import Triangles
from pathjax.until import render_until

PEER_SAMPLERS = ("independent", "multijitter", "ldsampler")
RAYS = 1 << 18
REFERENCE_SEED = 1 << 20  # no timed run has it


def run(options) -> int:
    """The command: `options` as `pathjax.cli` parses them."""
    folder = None if options.output is None else Path(options.output)
    if folder is not None and not folder.parent.is_dir():
        raise InputError(f"{folder}: there is no folder {folder.parent}; make it first")
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder")
    report = {"machine": machine(), "scenes": []}
    for file in options.scenes:
        report["scenes"].append(
            measure(
                file,
                dict(options.defines),
                options.spp,
                options.repeat,
                options.reference_spp,
                options.against,
                lambda message: print(message, file=sys.stderr),
            )
        )
    if folder is not None:
        folder.mkdir(exist_ok=True)
        write_text(folder / "bench.json", json.dumps(report, indent=2))
        write_text(folder / "bench.md", markdown(report))
    print(json.dumps(report) if options.json else markdown(report))
    return 0


def machine() -> dict:
    return {
        "processor": _processor(),
        "devices": len(jax.local_devices()),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "pathjax": pathjax.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def rel_mse(image, reference) -> float:
    """mean((I - R)^2 / (R^2 + 0.01)); nan if the image holds one."""
    reference = np.asarray(reference, float)
    return float(np.mean((np.asarray(image, float) - reference) ** 2 / (reference**2 + RELATIVE_FLOOR)))


def measure(file, defines, spps, repeat, reference_spp, against, say) -> dict:
    """Everything about one scene, as JSON-ready values."""
    scene = pathjax.load_scene(file, **defines)
    height, width = film.image_shape(scene.film)
    paths = height * width

    say(f"{file}: compiling")
    started = time.perf_counter()
    jax.block_until_ready(pathjax.render(scene, spp=1))
    cold = time.perf_counter() - started
    started = time.perf_counter()
    jax.block_until_ready(pathjax.render(scene, spp=1))
    compile_seconds = cold - (time.perf_counter() - started)

    say(f"{file}: reference, {reference_spp} spp")
    reference = render_until(scene, spp=reference_spp, seed=REFERENCE_SEED).image

    seconds = {spp: [] for spp in spps}
    errors = {spp: [] for spp in spps}

    def ours(seeds):
        for spp in spps:
            for seed in seeds:
                started = time.perf_counter()
                image = np.asarray(pathjax.render(scene, spp=spp, seed=seed))
                seconds[spp].append(time.perf_counter() - started)
                errors[spp].append(rel_mse(image, reference))

    say(f"{file}: pathjax")
    ours(range(0, repeat // 2))
    peers = []
    if against == "mitsuba":
        say(f"{file}: Mitsuba")
        peers = _mitsuba(file, defines, spps, repeat, reference, paths)
    ours(range(repeat // 2, repeat))

    rows = [_row(spp, spp, seconds[spp], errors[spp], paths) for spp in spps]
    for row in rows:
        best = max((p["efficiency"] for p in peers if p["asked_spp"] == row["spp"] and p["efficiency"]), default=None)
        row["efficiency_over_best_peer"] = best and row["efficiency"] and row["efficiency"] / best
    return {
        "file": str(file),
        "width": width,
        "height": height,
        "compile_seconds": compile_seconds,
        "reference_spp": reference_spp,
        "pathjax": rows,
        "mitsuba": peers,
        "rays": _rays(scene, repeat, say),
    }


def _row(asked, spp, seconds, errors, paths) -> dict:
    run, error = statistics.median(seconds), statistics.fmean(errors)
    return {
        "asked_spp": asked,
        "spp": spp,
        "run_seconds": run,
        "mpaths_per_second": paths * spp / run / 1e6,
        "rel_mse": error,
        "efficiency": 1 / (error * run) if error > 0 else None,  # a scene without noise has none
    }


def _mitsuba(file, defines, spps, repeat, reference, paths) -> list[dict]:
    runs = [
        {"sampler": sampler, "spp": spp, "seeds": list(range(1, repeat + 1))}
        for sampler in PEER_SAMPLERS
        for spp in spps
    ]
    try:
        report, arrays = mitsuba_peer.call({"scene": str(file), "parameters": defines, "runs": runs})
    except (mitsuba_peer.PeerMissing, mitsuba_peer.RequestError, mitsuba_peer.PeerFailed) as error:
        raise InputError(f"--against mitsuba: {error}") from None
    rows = []
    for k, (asked, done) in enumerate(zip(runs, report["runs"], strict=True)):
        errors = [rel_mse(image[..., :3], reference) for image in arrays[f"images_{k}"]]
        row = _row(asked["spp"], done["spp"], done["seconds"], errors, paths)
        rows.append({"sampler": asked["sampler"], "program": report["program"], **row})
    return rows


def _rays(scene, repeat, say) -> dict | None:
    """Closest hits on one core: rays from the camera, then from where they hit in uniform directions."""
    meshes = [table for table in scene.geometry.tables if isinstance(table, Triangles)]
    if not meshes:
        return None
    say("closest hits")
    rng = np.random.default_rng(0)
    positions, turns = rng.random((RAYS, 2), np.float32), rng.random((RAYS, 2), np.float32)
    rays = jax.vmap(lambda p: sample_ray(scene.camera, p, np.full(2, 0.5, np.float32)))(positions)
    hit = _closest_hit(scene.geometry, rays.o, rays.d, devices=1)
    found = np.isfinite(hit.t)
    points = np.asarray(rays.o + rays.d * np.where(found, hit.t, 1)[:, None])
    turned = np.asarray(jax.vmap(square_to_sphere)(turns))
    vertices = np.asarray(meshes[0].vertices).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    only_mesh = replace(scene.geometry, tables=(meshes[0],))
    result = {"triangles": len(faces)}
    for name, (o, d) in {"camera": (rays.o, rays.d), "scattered": (points, turned)}.items():
        o, d = np.asarray(o), np.asarray(d)
        seconds = []
        for _ in range(repeat + 1):
            started = time.perf_counter()
            jax.block_until_ready(_closest_hit(only_mesh, o, d, devices=1))
            seconds.append(time.perf_counter() - started)
        ours = RAYS / statistics.median(seconds[1:]) / 1e6
        try:
            report, _ = embree_peer.call(vertices, faces, o, d, repeat)
            embree = report["mrays_per_second"]
        except embree_peer.PeerMissing:
            embree = None
        result[name] = {"mrays_per_second": ours, "embree": embree, "ratio": embree and ours / embree}
    return result


def markdown(report: dict) -> str:
    """The report as tables."""
    about = report["machine"]
    lines = [
        f"{about['processor']}, {about['devices']} cores; Python {about['python']}, jax {about['jax']}, "
        f"pathjax {about['pathjax']}",
        "",
    ]
    for scene in report["scenes"]:
        lines += [
            f"## {scene['file']}, {scene['width']} x {scene['height']}",
            "",
            f"Compiled in {scene['compile_seconds']:.2f} s. Reference: {scene['reference_spp']} spp.",
            "",
            "| | spp | run s | Mpaths/s | relMSE | efficiency | over the best peer |",
            "|---|---|---|---|---|---|---|",
        ]
        for row in scene["pathjax"]:
            ratio = row["efficiency_over_best_peer"]
            lines.append(_line("pathjax", row, "" if ratio is None else f"{ratio:.2f}"))
        lines += [_line(f"{row['program']} {row['sampler']}", row, "") for row in scene["mitsuba"]]
        if scene["rays"]:
            rays = scene["rays"]
            lines += [
                "",
                f"| closest hits, {rays['triangles']} triangles, 1 core | Mray/s | Embree | ratio |",
                "|---|---|---|---|",
            ]
            for name in ("camera", "scattered"):
                row = rays[name]
                embree = "not installed | " if row["embree"] is None else f"{row['embree']:.2f} | {row['ratio']:.2f}"
                lines.append(f"| {name} rays | {row['mrays_per_second']:.2f} | {embree} |")
        lines.append("")
    return "\n".join(lines)


def _line(name: str, row: dict, ratio: str) -> str:
    efficiency = "" if row["efficiency"] is None else f"{row['efficiency']:.1f}"
    return (
        f"| {name} | {row['spp']} | {row['run_seconds']:.3f} | {row['mpaths_per_second']:.2f} | {row['rel_mse']:.2e} "
        f"| {efficiency} | {ratio} |"
    )
