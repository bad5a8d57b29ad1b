"""Render a scene in Mitsuba 3: times and images.

Needs NumPy and `pip install mitsuba` (3.7 or newer), and never imports jax: two thread pools in one process would
measure each other. A request, with defaults:

    {
      "scene": "scenes/cornell_box.xml",
      "parameters": {},                     # the file's $parameters, {"res": 128}
      "variant": "llvm_ad_rgb",             # or "scalar_rgb", which needs no LLVM
      "runs": [{"sampler": "independent", "spp": 64, "seeds": [1, 2, 3]}],
      "output": "peer.npz"
    }

OUTPUT.npz then holds, for run k, `images_k` (seeds, H, W, 3) float32. The report is

    {
      "program": "Mitsuba 3.9.1",
      "runs": [{"spp": 64, "seconds": [2.6, 2.6, 2.7], "cpu_seconds": [5.0, 5.0, 5.1]}]
    }

`spp` is the sampler's actual sample count: all samplers but independent may round up (stratified to a square, for
example). Mitsuba compiles and renders once before the timed renders; each of `seconds` runs from the call to the image
in NumPy, and `cpu_seconds` are those of all threads.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
OLDEST_LLVM = 17  # 14 to 16 abort the process: "Cannot select: fminimum"
WARM_UP_SEED = 987_654_321  # unlikely to be requested by a caller


class PeerMissing(RuntimeError):
    """Mitsuba, or an LLVM that it can use, is not installed; the message says what to do."""


class RequestError(ValueError):
    """The request asks for something that does not exist."""


def llvm_version(library: str) -> int:
    """Return the major version in an LLVM library's path, 0 if none: libLLVM.so.19.1, libLLVM-17.so, llvm-18/..."""
    name = os.path.basename(library)
    found = re.search(r"LLVM(?:-|\.so\.)(\d+)", name) or re.search(r"llvm(?:-|@|/)?(\d+)", library)
    return int(found[1]) if found and "libLLVM" in name else 0


def find_llvm() -> str:
    """Return the newest LLVM library of this machine, by its full path if known."""
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


def import_mitsuba(variant: str):
    """Import Mitsuba and set its variant."""
    if variant.startswith("llvm"):
        library = os.environ.get("DRJIT_LIBLLVM_PATH") or find_llvm()
        if 0 < llvm_version(library) < OLDEST_LLVM:
            raise PeerMissing(f"DRJIT_LIBLLVM_PATH names {library}: version {OLDEST_LLVM} or newer is needed")
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        import mitsuba as mi
    except ImportError as error:
        raise PeerMissing(f"Mitsuba cannot be imported ({error}): pip install mitsuba") from error
    if not hasattr(mi, "parser"):
        raise PeerMissing(f"Mitsuba {mi.__version__} is too old: pip install 'mitsuba>=3.7'")
    if variant not in mi.variants():
        raise RequestError(f"variant {variant!r} is unknown; use one of {', '.join(mi.variants())}")
    try:
        mi.set_variant(variant)
    except ImportError as error:
        raise PeerMissing(f"Mitsuba has no {variant} here: {error}".replace("\n", " ")) from error
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def load(mi, file: str, parameters: dict, sampler: str, spp: int):
    """Load the scene of an XML file with its sampler replaced, as if the file said <sampler type="SAMPLER">."""
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


def render_run(mi, scene, run: dict) -> tuple[dict, np.ndarray]:
    """Warm up, render once for each seed, and return an entry of the report and the images."""

    def timed(seed):
        start, worked = time.perf_counter(), time.process_time()
        image = np.array(mi.render(scene, seed=seed), dtype=np.float32)
        return image, time.perf_counter() - start, time.process_time() - worked

    timed(WARM_UP_SEED)
    images, seconds, cpu_seconds = zip(*map(timed, run["seeds"]), strict=True)
    spp = scene.sensors()[0].sampler().sample_count()
    return {"spp": spp, "seconds": seconds, "cpu_seconds": cpu_seconds}, np.stack(images)


def render(request: dict) -> tuple[dict, dict[str, np.ndarray]]:
    """Do all runs of a request, in this process, and return (report, arrays)."""
    mi = import_mitsuba(request.get("variant", "llvm_ad_rgb"))
    report, arrays = {"program": f"Mitsuba {mi.__version__}", "runs": []}, {}
    for k, run in enumerate(request["runs"]):
        scene = load(mi, request["scene"], request.get("parameters", {}), run["sampler"], run["spp"])
        entry, arrays[f"images_{k}"] = render_run(mi, scene, run)
        report["runs"].append(entry)
    return report, arrays


def main(file: str) -> int:
    request = json.loads(Path(file).read_text())
    try:
        report, arrays = render(request)
        np.savez(request["output"], **arrays)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    except PeerMissing as error:
        print(error, file=sys.stderr)
        return 3
    except (RuntimeError, OSError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 1
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
