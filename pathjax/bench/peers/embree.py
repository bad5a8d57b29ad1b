"""Closest hits in Embree, the baseline for ray rates: single rays, one thread, through embreex.

Needs NumPy and `pip install embreex trimesh`, and never imports jax. A request is

    {"rays": "rays.npz", "runs": 5, "output": "hits.npz"}

rays.npz holds `vertices` (V, 3), `faces` (F, 3), `origins` (N, 3) and `directions` (N, 3); hits.npz then holds
`primitive` (N,) int32, -1 for a miss. The report is

    {"mrays_per_second": 3.6}

from the median of `runs` calls, each over all rays, after one that is not timed. Embree gets float32, and the mesh is
moved to the origin and scaled to a box that suits its precision, as trimesh does; the time does not include this.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np


def closest_hits(vertices, faces, origins, directions, runs: int) -> tuple[dict, np.ndarray]:
    """Return the report and `primitive`, as documented at the top of this file."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    mesh = trimesh.Trimesh(np.asarray(vertices, np.float64), np.asarray(faces), process=False)
    wrapped = RayMeshIntersector(mesh)._scene
    o = ((np.asarray(origins, np.float64) - wrapped.origin) * wrapped.scale).astype(np.float32)
    d = np.ascontiguousarray(directions, np.float32)
    wrapped.scene.run(o[:1], d[:1])  # Embree builds its tree at the first ray
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        primitive = wrapped.scene.run(o, d)
        seconds.append(time.perf_counter() - start)
    report = {"mrays_per_second": len(o) / statistics.median(seconds[1:]) / 1e6}
    return report, np.asarray(primitive, np.int32)


def main(file: str) -> int:
    request = json.loads(Path(file).read_text())
    with np.load(request["rays"]) as rays:
        arrays = [rays[name] for name in ("vertices", "faces", "origins", "directions")]
    try:
        report, primitive = closest_hits(*arrays, request["runs"])
    except ImportError as error:
        print(f"Embree cannot be imported ({error}): pip install embreex trimesh", file=sys.stderr)
        return 3
    np.savez(request["output"], primitive=primitive)
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
