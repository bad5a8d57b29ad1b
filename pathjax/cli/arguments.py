"""Arguments of the command line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line; `command` of its result is the command's name."""
    program = argparse.ArgumentParser(prog="pathjax", description="A differentiable Monte Carlo path tracer.")
    subparsers = program.add_subparsers(required=True, dest="command", metavar="COMMAND")

    render = subparsers.add_parser("render", help="render a scene to an image")
    _add_scene(render)
    render.add_argument("-o", "--output", required=True, metavar="OUT.{exr,png}")
    spp = "maximal samples per pixel; default: the file's, if neither --error nor --time is given"
    render.add_argument("--spp", type=_positive, metavar="N", help=spp)
    error = "stop when the error, relative to the image's own level, is this low: 0.02 is 2 %%"
    render.add_argument("--error", type=_real, metavar="E", help=error)
    render.add_argument("--time", type=_real, metavar="SECONDS", help="stop after this many seconds of rendering")
    checkpoint = "save the state in this file, and continue from it when called again"
    render.add_argument("--checkpoint", metavar="FILE.npz", help=checkpoint)
    kinds, aov = "{error,depth,normal,albedo,bounces}", "more channels of the EXR file, separated by commas"
    render.add_argument("--aov", type=_comma_separated(str), default=[], metavar=kinds, help=aov)
    render.add_argument("--seed", type=_seed, default=0, metavar="K")
    render.add_argument("--strategy", default="mis", metavar="{mis,light,bsdf}", help="how light is sampled")
    render.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    _add_processes(render)

    batch = subparsers.add_parser("batch", help="render many scenes, which share kernels")
    batch.add_argument("jobs", metavar="JOBS.jsonl", help="a JSON object a line: see `pathjax help batch`")
    batch.add_argument("-o", "--output", required=True, metavar="DIR", help="the folder of the images")
    part = "render only every N-th job, from the I-th on, counted from 0, so that N processes share the work"
    batch.add_argument("--part", type=_part, default=(0, 1), metavar="I/N", help=part)
    batch.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    fit = subparsers.add_parser("fit", help="recover parameters from an image of the scene")
    _add_scene(fit)
    fit.add_argument("target", metavar="TARGET.{exr,png}")
    param = "a parameter to recover; may be repeated"
    fit.add_argument("--param", dest="params", action="append", required=True, metavar="NAME[=START]", help=param)
    fit.add_argument("--spp", type=_positive, default=128, metavar="N", help="of each of the two final renders")
    smooth = "how much neighbouring texels are expected to differ; auto: estimated from the images"
    fit.add_argument("--smoothness", type=_smoothness, metavar="S|auto", help=smooth)
    prior = "laplacian: they differ alike everywhere; total variation: few differ much, as at edges"
    fit.add_argument("--prior", default="laplacian", metavar="KIND", help=prior)
    fit.add_argument("--seed", type=_seed, default=0, metavar="K")
    wrote = "write PREFIX.json and PREFIX.png; for a texture also PREFIX.NAME.exr and the scene, PREFIX.xml"
    fit.add_argument("-o", "--output", default="fit", metavar="PREFIX", help=wrote)
    fit.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    _add_processes(fit)

    info = subparsers.add_parser("info", help="what a scene holds and what is compiled for it")
    _add_scene(info)
    tail = "suggest a max_depth that cuts off no more than this share of light (renders a few terms)"
    info.add_argument("--tail", type=_real, metavar="E", help=tail)
    info.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    convert = subparsers.add_parser("convert", help="write a scene, or glTF or a mesh, as a scene file of Mitsuba")
    _add_scene(convert)
    convert.add_argument("output", metavar="OUT.xml", help="its textures and meshes are written beside it")
    convert.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    bench = subparsers.add_parser("bench", help="speed against error")
    bench.add_argument("scenes", nargs="*", metavar="SCENE.xml", help="default: twelve scenes, with one summary number")
    bench.add_argument("-D", dest="defines", action="append", default=[], type=_pair, metavar="name=value")
    bench.add_argument("--against", choices=("mitsuba",), help="measure this peer in the same run")
    spp = "default: 16,64,256; 64 for the twelve"
    bench.add_argument("--spp", type=_comma_separated(_positive), metavar="16,64,256", help=spp)
    reference = "of the converged reference; default: 16384, or 2048 for the twelve"
    bench.add_argument("--reference-spp", type=_positive, metavar="N", help=reference)
    bench.add_argument("--repeat", type=_positive, default=5, metavar="N", help="timed runs of each; medians are shown")
    bench.add_argument("-o", "--output", metavar="DIR", help="also write bench.md, bench.json and plots to this folder")
    bench.add_argument("--quick", action="store_true", help="measure speed against error alone, as for the twelve")
    bunny = "a mesh, upright along y, to replace the generated one in a scene of the twelve"
    bench.add_argument("--bunny", metavar="MESH.ply", help=bunny)
    bench.add_argument("--resume", action="store_true", help="continue after the scenes in DIR/bench.json")
    bench.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    _add_processes(bench)

    compare = subparsers.add_parser(
        "compare",
        help="how an image differs from a reference",
        description="Compare image A with reference B in linear light: MSE; relMSE = mean((A - B)^2 / (B^2 + 0.01)); "
        "the error of `render --error`, which is sqrt(relMSE) if images are exposed so that B has the level 1; PSNR, "
        "whose peak is B's maximum; HDR-FLIP. Unless both are OpenEXR or Radiance HDR, the peak is 1 and FLIP is "
        "LDR-FLIP.",
        epilog="Exit status: 0 the images agree, or no limit was set; 1 they differ: a measure is above its "
        "limit, or with --errors p is below ALPHA; 2 the command or a file is wrong.",
    )
    compare.add_argument("image", metavar="A.{exr,png,jpg}")
    compare.add_argument("reference", metavar="B.{exr,png,jpg}")
    compare.add_argument(
        "--errors",
        action="store_true",
        help="weight differences by the standard errors in channels error.R, error.G, error.B of one or both; if only "
        "one has them, the other is taken as exact",
    )
    alpha = "with --errors: the false-alarm rate; default: 0.001"
    compare.add_argument("--alpha", type=_chance, default=1e-3, help=alpha)
    compare.add_argument("--max-relmse", type=_limit, metavar="X", help="differ where relMSE is above")
    error = "differ where the error is above"
    compare.add_argument("--max-error", type=_limit, metavar="E", help=error)
    compare.add_argument("--max-flip", type=_limit, metavar="X", help="differ where the mean of FLIP is above")
    picture = "a picture: A, B, their difference (red: A is brighter) and, with --errors, its z-scores"
    compare.add_argument("-o", "--output", metavar="DIFF.png", help=picture)
    compare.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    pages = subparsers.add_parser("help", help="show a page of the manual, or list the pages")
    pages.add_argument("topic", nargs="?", metavar="TOPIC")
    return program


def _add_scene(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE.xml", help="or glTF, or a mesh: .glb, .gltf, .obj, .ply, .stl")
    define = "replace a $name of the file"
    parser.add_argument(
        "-D", dest="defines", action="append", default=[], type=_pair, metavar="name=value", help=define
    )
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], type=_pair, metavar="NAME=VALUE", help="set a parameter"
    )
    sensor = "which of several sensors of the file: its number, from 0, or its id"
    parser.add_argument("--sensor", default="0", metavar="WHICH", help=sensor)


def _smoothness(text: str) -> float | str:
    return text if text == "auto" else _real(text)


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form name=value")
    return name, value


def _add_processes(parser: argparse.ArgumentParser) -> None:
    coordinator = "address of the first of several processes that share the work, or auto: find the cluster as JAX does"
    parser.add_argument("--coordinator", metavar="HOST:PORT", help=coordinator)
    parser.add_argument("--processes", type=_positive, metavar="N", help="number of processes")
    parser.add_argument("--process", type=_seed, metavar="I", help="index of this process, from 0")


def _part(text: str) -> tuple[int, int]:
    index, slash, count = text.partition("/")
    if not slash or not index.isdecimal() or not count.isdecimal() or not int(index) < int(count):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form I/N with 0 <= I < N")
    return int(index), int(count)


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise ValueError
    return int(text)


def _number(read: Callable, accepts: Callable, what: str) -> Callable:
    """Return an argparse type that converts text by `read` and refuses values that `accepts` rejects."""

    def parse(text: str):
        try:
            if accepts(value := read(text)):
                return value
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")

    return parse


_positive = _number(_whole, lambda n: 0 < n < 2**31, "a positive integer below 2^31")
_seed = _number(_whole, lambda n: n < 2**31, "an integer in [0, 2^31)")
_real = _number(float, lambda x: 0 < x < math.inf, "a positive number")
_limit = _number(float, lambda x: x >= 0, "a number that is not negative")
_chance = _number(float, lambda x: 0 <= x <= 1, "a number in [0, 1]")


def _comma_separated(read: Callable) -> Callable:
    return lambda text: [read(part) for part in text.split(",")]
