"""pathjax in a process of its own: for a meaningful peak memory, and for float64, which JAX sets per process.

A request is {"scene": FILE, "parameters": {}, "dtype": "float32", "spp": 16, "seeds": [0], "output": FILE.npz}. The npz
then holds `images` (seeds, H, W, 3), and the report is

    {"seconds": [0.1, ...], "peak_memory_bytes": 200000000}

The seconds are without compilation. The memory is the peak resident size, compilation included, less the size after
`import jax`; null on systems other than Linux, which do not report it.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np


def resident(name: str) -> int | None:
    """Return the resident bytes of this process from /proc: VmRSS the current, VmHWM the peak."""
    # getrusage's maximum would include that of the parent process.
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))
    except (OSError, StopIteration):
        return None


def main(file: str) -> None:
    request = json.loads(Path(file).read_text())
    import jax

    before = resident("VmRSS")
    import pathjax

    if request["dtype"] == "float64":
        jax.config.update("jax_enable_x64", True)
    scene = pathjax.load_scene(request["scene"], parameters=request["parameters"], dtype=request["dtype"])
    jax.block_until_ready(pathjax.render(scene, spp=1))
    images, seconds = [], []
    for seed in request["seeds"]:
        started = time.perf_counter()
        images.append(np.asarray(pathjax.render(scene, spp=request["spp"], seed=seed)))
        seconds.append(time.perf_counter() - started)
    peak = resident("VmHWM")
    np.savez(request["output"], images=np.stack(images))
    memory = None if before is None or peak is None else peak - before
    print(json.dumps({"seconds": seconds, "peak_memory_bytes": memory}))


if __name__ == "__main__":
    main(sys.argv[1])
