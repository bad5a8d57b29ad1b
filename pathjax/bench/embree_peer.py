"""Closest hits in Embree, the yardstick for ray rates: single rays, one thread, through embreex.

    python embree_peer.py RAYS.npz HITS.npz [RUNS]

needs NumPy and `pip install embreex trimesh`, and never imports jax. RAYS.npz holds `vertices` (V, 3), `faces` (F, 3),
`origins` (N, 3) and `directions` (N, 3); HITS.npz then holds `primitive` (N,) int32, -1 for a miss. Stdout gets

    {"program": "Embree (embreex 4.4.0)", "rays": 262144, "triangles": 81920, "build_seconds": 0.1,
     "seconds": [0.07, ...], "median_seconds": 0.07, "mrays_per_second": 3.6}

RUNS, 5 unless given, are timed after one that is not. Exit status 3: embreex is missing.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


class PeerMissing(RuntimeError):
    """embreex is not installed."""


def closest_hits(vertices, faces, origins, directions, runs: int = 5) -> tuple[dict, np.ndarray]:
    """Time closest hits in this process.

    The median is of `runs` calls, each over all rays. Embree gets float32, the mesh moved to the origin and scaled to
    a box that suits its precision (as trimesh does); that preparation of the rays is no part of the time.

    Returns:
        (report, primitive): as at the top of this file.
    """
    try:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError as error:
        raise PeerMissing(f"Embree cannot be imported ({error}): pip install embreex trimesh") from error

    start = time.perf_counter()
    mesh = trimesh.Trimesh(np.asarray(vertices, np.float64), np.asarray(faces), process=False)
    wrapped = RayMeshIntersector(mesh)._scene
    build = time.perf_counter() - start
    o = ((np.asarray(origins, np.float64) - wrapped.origin) * wrapped.scale).astype(np.float32)
    d = np.ascontiguousarray(directions, np.float32)
    wrapped.scene.run(o[:1], d[:1])  # Embree builds its tree at the first ray
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        primitive = wrapped.scene.run(o, d)
        seconds.append(time.perf_counter() - start)
    seconds = seconds[1:]
    report = {
        "program": f"Embree (embreex {importlib.metadata.version('embreex')})",
        "rays": len(o),
        "triangles": len(mesh.faces),
        "build_seconds": build,
        "seconds": seconds,
        "median_seconds": statistics.median(seconds),
        "mrays_per_second": len(o) / statistics.median(seconds) / 1e6,
    }
    return report, np.asarray(primitive, np.int32)


def call(vertices, faces, origins, directions, runs: int = 5, timeout: float | None = None) -> tuple[dict, np.ndarray]:
    """`closest_hits` in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        rays, hits = os.path.join(folder, "rays.npz"), os.path.join(folder, "hits.npz")
        np.savez(rays, vertices=vertices, faces=faces, origins=origins, directions=directions)
        command = [sys.executable, "-P", str(Path(__file__).resolve()), rays, hits, str(runs)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=timeout)
        if done.returncode:
            message = (done.stderr.strip().splitlines() or [f"it ended with status {done.returncode}"])[-1]
            raise (PeerMissing if done.returncode == 3 else RuntimeError)(message)
        with np.load(hits) as arrays:
            return json.loads(done.stdout), arrays["primitive"]


def main(arguments: list[str]) -> int:
    if len(arguments) not in (2, 3):
        print("usage: python embree_peer.py RAYS.npz HITS.npz [RUNS]", file=sys.stderr)
        return 2
    try:
        with np.load(arguments[0]) as rays:
            named = [rays[name] for name in ("vertices", "faces", "origins", "directions")]
        report, primitive = closest_hits(*named, runs=int(arguments[2]) if len(arguments) == 3 else 5)
    except (OSError, KeyError, ValueError) as error:
        print(f"embree_peer: {arguments[0]}: {error}", file=sys.stderr)
        return 2
    except PeerMissing as error:
        print(f"embree_peer: {error}", file=sys.stderr)
        return 3
    np.savez(arguments[1], primitive=primitive)
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
