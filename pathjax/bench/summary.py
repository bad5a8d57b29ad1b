"""Summary of a bench of many scenes: a row for each, the geometric mean of the efficiency ratios, and the worst."""

from __future__ import annotations

import math
from pathlib import Path

from pathjax.bench import figures

USUAL_SPP = 64


def summary(scenes: list[dict]) -> dict:
    """Summarise scenes returned by `measure`, all with the same spps, at 64 spp or else the middle one.

    Ratios of time and relMSE are the best peer's over pathjax's, those of efficiency pathjax's over the best peer's:
    above 1 pathjax is ahead. None without a peer or without noise.
    """
    spps = [row["asked_spp"] for row in scenes[0]["pathjax"]]
    spp = USUAL_SPP if USUAL_SPP in spps else spps[len(spps) // 2]
    names = [Path(scene["file"]).stem for scene in scenes]
    rows = [
        {"scene": name if names.count(name) == 1 else scene["file"], **_row(scene, spp)}
        for name, scene in zip(names, scenes, strict=True)
    ]
    return {"spp": spp, "rows": rows, "wall": _over_all(rows, "efficiency_ratio"), "cpu": _over_all(rows, "cpu_ratio")}


def _row(scene: dict, spp: int) -> dict:
    ours = next(row for row in scene["pathjax"] if row["asked_spp"] == spp)
    best = figures.best(scene["mitsuba"], spp)
    row = {"seconds": ours["run_seconds"], "rel_mse": ours["rel_mse"], "compile_seconds": scene["compile_seconds"]}
    if best is None or not ours["efficiency"]:
        ratios = "efficiency_ratio", "cpu_ratio", "time_ratio", "rel_mse_ratio", "relative_error", "best_peer"
        return row | dict.fromkeys(ratios)
    error, time = best["rel_mse"] / ours["rel_mse"], best["run_seconds"] / ours["run_seconds"]
    cpu_time = best["cpu_seconds"] / ours["cpu_seconds"]
    return row | {
        "efficiency_ratio": error * time,
        "cpu_ratio": error * cpu_time,  # efficiency ratio by CPU seconds
        "time_ratio": time,
        "rel_mse_ratio": error,
        # relative standard error of the ratios, from that of the two errors only
        "relative_error": math.hypot(*(each["rel_mse_standard_error"] / each["rel_mse"] for each in (ours, best))),
        "best_peer": best["sampler"],
    }


def _over_all(rows: list[dict], key: str) -> dict | None:
    """Return the geometric mean and the worst of the known values."""
    known = {row["scene"]: row[key] for row in rows if row[key]}
    if not known:
        return None
    worst = min(known, key=known.__getitem__)
    mean = math.exp(sum(map(math.log, known.values())) / len(known))
    return {"geometric_mean": mean, "worst": known[worst], "worst_scene": worst, "scenes": len(known)}
