"""How evenly the work of an image is shared by many cores: `pathjax help planning` tells what came out.

    python examples/planning.py scenes/cornell_box.xml

Measures what runs of pixels of an image cost, and deals them out as kernels and as render_until do. Prints the share of
the time in which cores work, and writes planning.png: what pixels cost, from the least (black) to the most (white).
"""

import argparse
import heapq
import time
from pathlib import Path

import numpy as np

import pathjax as pj
from pathjax.distributed import CALLS
from pathjax.images import write_png
from pathjax.integrators.options import Options
from pathjax.rendering.progressive import passes
from pathjax.scene.ladder import padded

RUN, TIMES = 120, 7  # pixels side by side that are measured at once, and how often


def costs(scene, res, rows, spp):
    """Seconds of a core for runs of some rows, (rows, runs): the least of some, as other work only ever adds."""
    kernel = passes.compile(padded(scene), Options(), RUN)
    seconds = np.full((TIMES, rows, res // RUN), np.inf)
    order = np.random.default_rng(0).permutation(seconds.size)  # what else the machine does is no row's alone
    for place in zip(*np.unravel_index(order, seconds.shape), strict=True):
        _, row, run = place
        numbers = np.zeros((3, RUN), np.int32)
        numbers[0] = row * res // rows * res + run * RUN + np.arange(RUN)
        numbers[2] = spp
        begin = time.process_time()
        np.asarray(kernel(numbers, np.uint32(1)))
        seconds[place] = time.process_time() - begin
    return seconds.min(0)


def busy_in_kernel(pixels, devices):
    """Device i takes the pixels i, i + devices, ...: mean over largest load."""
    loads = np.pad(pixels, (0, -len(pixels) % devices)).reshape(-1, devices).sum(0)
    return loads.mean() / loads.max()


def busy_in_calls(pixels, nodes, cores):
    """Calls of `render_until` in one pass: several processes wait for each other after every CALLS of each core."""
    size = passes.pixels_per_call(len(pixels), nodes * cores)
    calls = np.add.reduceat(pixels, np.arange(0, len(pixels), size))
    together = CALLS * cores * nodes if nodes > 1 else len(calls)
    waited = 0.0
    for first in range(0, len(calls), together):
        ends = [[0.0] * cores for _ in range(nodes)]
        for number, call in enumerate(calls[first : first + together]):
            own = ends[number % nodes]
            heapq.heapreplace(own, own[0] + call)
        waited += max(map(max, ends))
    return size, pixels.sum() / (waited * nodes * cores)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scenes = Path(__file__).parents[1] / "scenes"
    parser.add_argument("scene", nargs="?", default=scenes / "cornell_box.xml")
    parser.add_argument("--res", type=int, default=2880, help=f"of a square image, a multiple of {RUN}")
    parser.add_argument("--rows", type=int, default=90, help="how many of its rows are measured")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--cores", type=int, default=64, help="of a node")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 16, 1000])
    parser.add_argument("-o", "--output", default="planning.png")
    options = parser.parse_args()

    res = options.res
    measured = costs(pj.load_scene(options.scene, res=res), res, options.rows, options.spp)
    print(f"{RUN * options.spp / measured.mean() / 1e6:.1f} million paths a second and core")
    rows = np.arange(res) * options.rows // res
    pixels = np.repeat(measured[rows].ravel() / RUN, RUN)
    print("nodes   busy in a kernel   pixels of a call   busy in calls")
    for nodes in options.nodes:
        size, busy = busy_in_calls(pixels, nodes, options.cores)
        print(f"{nodes:5} {busy_in_kernel(pixels, nodes * options.cores):18.1%} {size:18} {busy:15.1%}")
    grey = (measured - measured.min()) / np.ptp(measured)
    shown = np.repeat(np.repeat(grey, 4, axis=0), 15, axis=1)
    write_png(options.output, np.repeat(shown[:, :, None], 3, axis=2))


if __name__ == "__main__":
    main()
