"""Render a scene in Mitsuba 3, the peer, in a process of its own: times and images, or means and variances.

    python mitsuba_peer.py REQUEST.json

needs NumPy and `pip install mitsuba` (3.7 or newer), and never imports jax: two thread pools in one process would
measure each other. From Python, `call(request)` starts that process and reads what it wrote. A request, with defaults:

    {
      "scene": "scenes/cornell_box.xml",
      "parameters": {},                     # the file's $parameters, {"res": 128}
      "variant": "llvm_ad_rgb",             # or "scalar_rgb", which needs no LLVM
      "threads": null,                      # null: one per core
      "runs": [{"sampler": "independent", "spp": 64, "seeds": [1, 2, 3], "statistics": false}],
      "reference": null,                    # or a run; it is taken with statistics
      "output": "peer.npz"
    }

OUTPUT.npz then holds, for run k, `images_k` (seeds, H, W, 3) float32, or with statistics `mean_k` and
`variance_of_mean_k`, (H, W, 3) float64 over the seeds (2 at least); `reference` and `reference_variance_of_mean`; and
`report`, the JSON text that also goes to stdout:

    {
      "program": "Mitsuba 3.9.1", "variant": "llvm_ad_rgb", "threads": 2, "width": 256, "height": 256,
      "load_seconds": 0.1,
      "runs": [{"sampler": "independent", "requested_spp": 64, "spp": 64, "seeds": [1, 2, 3], "statistics": false,
                "warm_up_seconds": 3.1, "seconds": [2.6, 2.6, 2.7], "median_seconds": 2.6, "mpaths_per_second": 1.6,
                "nonfinite": 0}],
      "reference": null                     # or one such entry
    }

`spp` is what the sampler really took: all but independent may round up (stratified to a square, say). The warm-up
compiles (Dr.Jit keeps kernels on disk, so a second process warms up faster) and renders once; it is no part of
`seconds`, each of which runs from the call to the image in NumPy. A statistic over seeds supposes `independent`.

Exit status: 0 done, 1 the render failed, 2 the request is wrong, 3 Mitsuba or a suitable LLVM is missing.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
OLDEST_LLVM = 17  # 14 to 16 abort the process: "Cannot select: fminimum"
WARM_UP_SEED = 987_654_321  # not one that a caller is likely to ask for


class PeerMissing(RuntimeError):
    """Mitsuba, or an LLVM that it can use, is not installed; the message says what to do."""


class RequestError(ValueError):
    """The request asks for something that does not exist."""


class PeerFailed(RuntimeError):
    """The peer's process ended without an answer."""


# ---- for the program that asks ---------------------------------------------------------------------------------------
def call(request: dict, timeout: float | None = None) -> tuple[dict, dict[str, np.ndarray]]:
    """Run a request in a process of its own.

    Args:
        request: as at the top of this file; without "output" its images go through a temporary file.
        timeout: seconds, after which the process is ended.
    Returns:
        (report, arrays): the report at the top of this file, and the arrays of the npz by name.
    Raises:
        PeerMissing, RequestError, PeerFailed; subprocess.TimeoutExpired.
    """
    with tempfile.TemporaryDirectory() as folder:
        request = {"output": str(Path(folder, "peer.npz")), **request}
        file = Path(folder, "request.json")
        file.write_text(json.dumps(request))
        # -P: the modules beside this file must not shadow the standard library's
        command = [sys.executable, "-P", str(Path(__file__).resolve()), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=timeout)
        if done.returncode:
            message = done.stderr.strip().splitlines()[-1:] or [f"it ended with status {done.returncode}"]
            raise {2: RequestError, 3: PeerMissing}.get(done.returncode, PeerFailed)(message[0])
        with np.load(request["output"]) as arrays:
            arrays = {name: arrays[name] for name in arrays.files}
    return json.loads(str(arrays.pop("report"))), arrays


# ---- in the peer's process -------------------------------------------------------------------------------------------
def llvm_version(library: str) -> int:
    """Major version that the path of an LLVM library tells, 0 if none: libLLVM.so.19.1, libLLVM-17.so, llvm-18/..."""
    name = os.path.basename(library)
    found = re.search(r"LLVM(?:-|\.so\.)(\d+)", name) or re.search(r"llvm(?:-|@|/)?(\d+)", library)
    return int(found[1]) if found and "libLLVM" in name else 0


def find_llvm() -> str:
    """The newest LLVM library of this machine, by its full path where that is known."""
    candidates = []
    try:
        listed = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True, check=False).stdout
        candidates += re.findall(r"=> (\S*libLLVM\S*)", listed)
    except OSError:
        pass  # not Linux, or a bare one
    linux = ("usr/lib", "usr/lib64", "usr/lib/*-linux-gnu", "usr/lib/llvm*/lib*", "usr/local/lib")
    mac = ("usr/local/opt/llvm*/lib", "opt/homebrew/opt/llvm*/lib")
    for folder in (*linux, *mac):
        for ending in ("so*", "dylib"):
            candidates += [str(path) for path in Path("/").glob(f"{folder}/libLLVM*.{ending}")]
    if prefix := os.environ.get("CONDA_PREFIX"):
        candidates += [str(path) for path in Path(prefix, "lib").glob("libLLVM*")]
    newest = max(candidates, key=llvm_version, default="")
    if llvm_version(newest) < OLDEST_LLVM:
        raise PeerMissing(
            f"Mitsuba's LLVM variants need an LLVM library of version {OLDEST_LLVM} or newer and none was found: "
            "install one (Debian and Ubuntu: apt-get install libllvm19), or set DRJIT_LIBLLVM_PATH to it, "
            "or ask for the variant scalar_rgb"
        )
    return newest


def import_mitsuba(variant: str, threads: int | None):
    """Mitsuba with `variant` set."""
    if variant.startswith("llvm"):
        library = os.environ.get("DRJIT_LIBLLVM_PATH") or find_llvm()
        if 0 < llvm_version(library) < OLDEST_LLVM:
            raise PeerMissing(f"DRJIT_LIBLLVM_PATH names {library}: version {OLDEST_LLVM} or newer is needed")
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        import drjit
        import mitsuba as mi
    except ImportError as error:
        raise PeerMissing(f"Mitsuba cannot be imported ({error}): pip install mitsuba") from error
    if not hasattr(mi, "parser"):
        raise PeerMissing(f"Mitsuba {mi.__version__} is too old: pip install 'mitsuba>=3.7'")
    if variant not in mi.variants():
        raise RequestError(f"variant {variant!r} is unknown; use one of {', '.join(mi.variants())}")
    if threads:
        drjit.set_thread_count(threads)
    try:
        mi.set_variant(variant)
    except ImportError as error:
        raise PeerMissing(f"Mitsuba has no {variant} here: {error}".replace("\n", " ")) from error
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def load(mi, file: str, parameters: dict, sampler: str, spp: int):
    """The scene of an XML file with its sampler replaced, as if the file said <sampler type="SAMPLER">."""
    if sampler not in SAMPLERS:
        raise RequestError(f"sampler {sampler!r} is unknown; use one of {', '.join(SAMPLERS)}")
    if not os.path.isfile(file):
        raise RequestError(f"{file}: no such file")
    config = mi.parser.ParserConfig(mi.variant())
    config.unused_parameters = mi.LogLevel.Error
    given = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in parameters.items()}
    mi.file_resolver().prepend(str(Path(file).resolve().parent))  # where its meshes and textures lie
    state = mi.parser.parse_file(config, file, **given)
    nodes = [node for node in state.nodes if node.type == mi.ObjectType.Sampler]
    if not nodes:
        raise RequestError(f'{file}: its sensor names no <sampler type="independent">, so none can be replaced')
    for node in nodes:
        node.props.set_plugin_name(sampler)
        node.props["sample_count"] = spp
    mi.parser.transform_all(config, state)
    scene = mi.parser.instantiate(config, state)
    return scene[0] if isinstance(scene, list) else scene


def render_run(mi, scene, run: dict) -> tuple[dict, dict[str, np.ndarray]]:
    """Warm up, then render once for each seed.

    Returns:
        (entry of the report, {"images": ...} or {"mean": ..., "variance_of_mean": ...}).
    """

    def timed(seed):
        start = time.perf_counter()
        image = np.array(mi.render(scene, seed=seed), dtype=np.float32)
        return image, time.perf_counter() - start

    seeds, wants_statistics = run["seeds"], run.get("statistics", False)
    _, warm_up = timed(WARM_UP_SEED)
    seconds, images, nonfinite = [], [], 0
    mean = squares = 0.0
    for count, seed in enumerate(seeds, 1):
        image, elapsed = timed(seed)
        seconds.append(elapsed)
        nonfinite += int(np.sum(~np.isfinite(image)))
        if wants_statistics:  # Welford's, so that memory does not grow with the seeds
            delta = image.astype(np.float64) - mean
            mean = mean + delta / count
            squares = squares + delta * (image - mean)
        else:
            images.append(image)
    height, width = image.shape[:2]
    spp = scene.sensors()[0].sampler().sample_count()
    entry = {
        "sampler": run["sampler"],
        "requested_spp": run["spp"],
        "spp": spp,
        "seeds": list(seeds),
        "statistics": wants_statistics,
        "warm_up_seconds": warm_up,
        "seconds": seconds,
        "median_seconds": statistics.median(seconds),
        "mpaths_per_second": width * height * spp / statistics.median(seconds) / 1e6,
        "nonfinite": nonfinite,
    }
    if wants_statistics:
        return entry, {"mean": mean, "variance_of_mean": squares / (len(seeds) - 1) / len(seeds)}
    return entry, {"images": np.stack(images)}


def check(request: dict) -> None:
    """Refuse a request that lacks something, before anything is started."""
    if not isinstance(request, dict):
        raise RequestError("the request is no JSON object")
    if unknown := set(request) - {"scene", "parameters", "variant", "threads", "runs", "reference", "output"}:
        raise RequestError(f"the request has unknown keys: {', '.join(sorted(unknown))}")
    for key in ("scene", "output"):
        if not isinstance(request.get(key), str):
            raise RequestError(f"the request lacks {key!r}, a path")
    runs = [*request.get("runs", []), *([request["reference"]] if request.get("reference") else [])]
    if not runs:
        raise RequestError("the request names no run and no reference")
    for run in runs:
        if unknown := set(run) - {"sampler", "spp", "seeds", "statistics"}:
            raise RequestError(f"a run has unknown keys: {', '.join(sorted(unknown))}")
        if run.get("sampler") not in SAMPLERS:
            raise RequestError(f"sampler {run.get('sampler')!r} is unknown; use one of {', '.join(SAMPLERS)}")
        if not isinstance(run.get("spp"), int) or run["spp"] < 1:
            raise RequestError("a run needs spp, a whole number of at least 1")
        fewest = 2 if run.get("statistics") or run is request.get("reference") else 1
        if len(run.get("seeds", ())) < fewest:
            raise RequestError(f"a run needs a list of seeds, {fewest} at least here")


def render(request: dict) -> tuple[dict, dict[str, np.ndarray]]:
    """All runs of a request, in this process: (report, arrays)."""
    check(request)
    variant = request.get("variant") or "llvm_ad_rgb"
    mi = import_mitsuba(variant, request.get("threads"))
    import drjit

    report = {"program": f"Mitsuba {mi.__version__}", "variant": variant, "threads": drjit.thread_count()}
    arrays: dict[str, np.ndarray] = {}

    def one(run):
        start = time.perf_counter()
        scene = load(mi, request["scene"], request.get("parameters") or {}, run["sampler"], run["spp"])
        report.setdefault("load_seconds", time.perf_counter() - start)
        width, height = scene.sensors()[0].film().crop_size()
        report.update(width=int(width), height=int(height))
        return render_run(mi, scene, run)

    report["runs"] = []
    for k, run in enumerate(request.get("runs", [])):
        entry, images = one(run)
        report["runs"].append(entry)
        arrays |= {f"{name}_{k}": value for name, value in images.items()}
    report["reference"] = None
    if request.get("reference"):
        report["reference"], images = one({**request["reference"], "statistics": True})
        arrays |= {"reference": images["mean"], "reference_variance_of_mean": images["variance_of_mean"]}
    return report, arrays


def main(arguments: list[str]) -> int:
    if len(arguments) != 1:
        print("usage: python mitsuba_peer.py REQUEST.json", file=sys.stderr)
        return 2
    try:
        try:
            request = json.loads(Path(arguments[0]).read_text())
        except (OSError, ValueError) as error:
            raise RequestError(f"{arguments[0]}: {error}") from error
        report, arrays = render(request)
        beside = request["output"] + ".part"
        with open(beside, "wb") as file:
            np.savez(file, report=json.dumps(report), **arrays)
        os.replace(beside, request["output"])
    except RequestError as error:
        print(f"mitsuba_peer: {error}", file=sys.stderr)
        return 2
    except PeerMissing as error:
        print(f"mitsuba_peer: {error}", file=sys.stderr)
        return 3
    except (RuntimeError, OSError) as error:
        print("mitsuba_peer:", " ".join(str(error).split()), file=sys.stderr)
        return 1
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
