"""Closest hits per second on one core, and those of Embree on the same triangles."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from dataclasses import replace

import jax
import numpy as np

from pathjax.bench import peers
from pathjax.core.warp import square_to_sphere
from pathjax.rendering.query import _closest_hit

RAYS = 1 << 18


def rates(scene, repeat: int) -> tuple[dict, dict | None]:
    """Measure rays from the camera, and rays from their hits in uniform directions.

    Returns:
        Mray/s on all shapes, by kind of ray; and on the triangles alone beside Embree, None without triangles.
    """
    kinds = {"camera": _camera_rays(scene)}
    kinds["scattered"] = _scattered_rays(scene.geometry, *kinds["camera"])
    all_shapes = {name: _rate(scene.geometry, *rays, repeat) for name, rays in kinds.items()}
    mesh = next((table for table in scene.geometry.tables if table.triangular), None)
    if mesh is None:
        return all_shapes, None
    only_mesh = replace(scene.geometry, tables=(mesh,))
    vertices = np.asarray(mesh.vertices).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    beside = {"triangles": len(faces)}
    for name, rays in kinds.items():
        ours, embree = _rate(only_mesh, *rays, repeat), _embree(vertices, faces, *rays, repeat)
        beside[name] = {"mrays_per_second": ours, "embree": embree, "ratio": embree and ours / embree}
    return all_shapes, beside


def _camera_rays(scene):
    positions = np.random.default_rng(0).random((RAYS, 2), np.float32)
    rays = jax.vmap(lambda p: scene.camera.sample_ray(p, np.full(2, 0.5, np.float32)))(positions)
    return np.asarray(rays.o), np.asarray(rays.d)


def _scattered_rays(geometry, o, d):
    t = np.asarray(_closest_hit(geometry, o, d, devices=1).t)
    turns = np.random.default_rng(1).random((RAYS, 2), np.float32)
    return o + d * np.where(np.isfinite(t), t, 1)[:, None], np.asarray(jax.vmap(square_to_sphere)(turns))


def _rate(geometry, o, d, repeat: int) -> float:
    seconds = []
    for _ in range(repeat + 1):
        started = time.perf_counter()
        jax.block_until_ready(_closest_hit(geometry, o, d, devices=1))
        seconds.append(time.perf_counter() - started)
    return RAYS / statistics.median(seconds[1:]) / 1e6


def _embree(vertices, faces, o, d, repeat: int) -> float | None:
    with tempfile.TemporaryDirectory() as folder:
        file = os.path.join(folder, "rays.npz")
        np.savez(file, vertices=vertices, faces=faces, origins=o, directions=d)
        try:
            report, _ = peers.call("embree", {"rays": file, "runs": repeat})
        except (peers.PeerMissing, peers.PeerFailed):
            return None
    return report["mrays_per_second"]
