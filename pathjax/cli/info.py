"""`pathjax info`: the contents of a scene, the kinds compiled for it, its parameters, its hierarchies."""

from __future__ import annotations

import numpy as np

from pathjax import bsdfs, emitters, media
from pathjax.cli import DONE
from pathjax.cli.inputs import load
from pathjax.kinds.parameter import Parameter
from pathjax.rendering import bounces
from pathjax.rendering.tail import check_share
from pathjax.scene.parameters import parameters
from pathjax.scene.scene import UNBOUNDED, Scene
from pathjax.sensors import film
from pathjax.shapes.accel.leaves import rows_of
from pathjax.system.json_text import json_text
from pathjax.system.output import Output

_SAMPLER = "randomly shifted lattice, hashing for roulette"


def run(options, output: Output) -> int:
    scene = load(options)
    facts = scene_facts(scene)
    if options.tail is not None:
        facts["tail"] = tail_facts(scene, options.tail)
    output.text(json_text(facts) if options.json else text(facts))
    return DONE


def scene_facts(scene: Scene) -> dict:
    """Return the facts of a scene as a dictionary for `json_text`."""
    about = scene.about
    description = about.description
    max_depth = int(scene.max_depth)
    parts = [part for table in scene.geometry.tables for part in table.searched()]
    height, width = film.image_shape(scene.film)
    dark = emitters.darkness(scene.emitters, scene.samples_lights)
    return {
        "file": description.file,
        "image": {"width": width, "height": height, "filter": _type(scene.film.filter), "spp": description.view.spp},
        "camera": _type(description.view.camera),
        "integrator": {
            "max_depth": None if max_depth == UNBOUNDED else max_depth,
            "rr_depth": int(scene.rr_depth),
            "hide_emitters": scene.hide_emitters,
        },
        "sampler": {"file": description.view.sampler, "used": _SAMPLER},
        "shapes": len(description.shapes),
        "primitives": {f"{part.kind}s": _primitives(part) for part in parts},
        "compiled": {
            "shapes": [f"{part.kind}s ({'tree' if part.tree else 'flat'})" for part in parts],
            "bsdfs": [bsdfs.name(scene.materials, kind) for kind in range(len(scene.materials.tables))],
            "light sampling": scene.samples_lights and emitters.sampled(scene.emitters),
            "emitters": [emitters.name(lights) for lights in scene.emitters],
            "media": [] if scene.media is None else media.names(scene.media),
            "dtype": str(scene.camera.origin.dtype),
        },
        "trees": {
            kind: {
                "nodes": len(tree.child),
                "leaves": len(tree.leaf_first),
                "depth": tree.depth,
                "primitives per leaf": float(tree.leaf_count.mean()),
                "sah cost": float(tree.sah_cost),
            }
            for kind, tree in about.trees.items()
        },
        "parameters": {
            name: _parameter_facts(about.parameters[name], np.asarray(value))
            for name, value in parameters(scene).items()
        },
        "notes": [*description.notes, *([f"{dark}, so images are black"] if dark else [])],
    }


def _parameter_facts(parameter: Parameter, value: np.ndarray) -> dict:
    """Return value, shape and bounds of a parameter; for a texture or a grid, the mean in place of all values."""
    known = {"value": value}
    if parameter.is_texture:
        entries = (0, 1) if value.ndim < 3 and parameter.corners is None else tuple(range(value.ndim - 1))
        known = {"mean": value.mean(entries)}
    return known | {"shape": value.shape, "bounds": parameter.bounds}


def tail_facts(scene: Scene, error: float) -> dict:
    """Estimate the light that max_depth cuts off, and the max_depth that cuts off a share `error`, by a quick render.

    Raises:
        InputError: error is not between 0 and 1.
    """
    check_share(error)  # before anything is rendered
    tail, max_depth = bounces.pilot(scene), int(scene.max_depth)
    share, uncertainty = tail.cut_off(max_depth)
    return {
        "error": error,
        "terms": tail.terms,
        "ratio": tail.ratio,
        "cut_off": share if max_depth < UNBOUNDED else [0.0] * 3,
        "cut_off_error": uncertainty if max_depth < UNBOUNDED else [0.0] * 3,
        "max_depth": tail.depth_for(error),
    }


def _tail_lines(tail: dict, max_depth) -> list[str]:
    if tail["max_depth"] is None:
        return [f"tail        the last of {len(tail['terms'])} terms do not decay, so no max_depth can be suggested"]
    worst = int(np.argmax(tail["cut_off"]))
    ratio = ", ".join(f"{x:.3g}" for x in tail["ratio"])
    lines = [f"tail        each bounce leaves {ratio} of the light before it (red, green, blue)"]
    if max_depth is not None:
        share, uncertainty = tail["cut_off"][worst], tail["cut_off_error"][worst]
        lines.append(f"            max_depth {max_depth} cuts off {share:.2g} +- {uncertainty:.1g} of all light")
    lines.append(f"            max_depth {tail['max_depth']} would cut off no more than {tail['error']:g}")
    return lines


def _type(described) -> str:
    """Return the name of a kind in scene files."""
    return type(described).__name__.lower()


def _primitives(part) -> int:
    return int((rows_of(part.leaves) >= 0).sum())


def text(facts: dict) -> str:
    """Format the facts of a scene as text."""
    image, integrator, compiled = facts["image"], facts["integrator"], facts["compiled"]
    depth = "unbounded" if integrator["max_depth"] is None else integrator["max_depth"]
    lines = [
        facts["file"],
        f"image       {image['width']} x {image['height']}, {image['filter']} filter, {image['spp']} spp by default",
        f"camera      {facts['camera']}",
        f"integrator  path, max_depth {depth}, roulette from depth {integrator['rr_depth']}"
        + (", emitters hidden" if integrator["hide_emitters"] else ""),
        f"sampler     {facts['sampler']['used']} (the file asks for {facts['sampler']['file']})",
        f"shapes      {facts['shapes']}: {_listed(f'{n} {kind}' for kind, n in facts['primitives'].items())}",
        f"compiled    {_listed([*compiled['shapes'], *compiled['bsdfs']])}; {compiled['dtype']}",
        *([f"media       {_listed(compiled['media'])}"] if compiled["media"] else []),
        "lights      " + _listed(compiled["emitters"]) + ("" if compiled["light sampling"] else ", not sampled"),
    ]
    for kind, tree in facts["trees"].items():
        lines.append(
            f"tree        {kind}s: {tree['nodes']} nodes, {tree['leaves']} leaves "
            f"of {tree['primitives per leaf']:.1f}, depth {tree['depth']}, SAH cost {tree['sah cost']:.1f}"
        )
    if "tail" in facts:
        lines += _tail_lines(facts["tail"], integrator["max_depth"])
    lines.append("parameters" if facts["parameters"] else "parameters  none")
    for name, parameter in facts["parameters"].items():
        low, high = parameter["bounds"]
        shown = ", ".join(f"{x:g}" for x in (parameter["mean"] if "mean" in parameter else parameter["value"]).ravel())
        if "mean" in parameter:
            size = parameter["shape"][: len(parameter["shape"]) - parameter["mean"].ndim]
            shown = f"{' x '.join(map(str, size))} {'texels' if len(size) == 2 else 'values'}, mean {shown}"
        lines.append(f"  {name:32} {shown:28} in [{low:g}, {high:g}]")
    lines += [f"note        {note}" for note in facts["notes"]]
    return "\n".join(lines)


def _listed(items) -> str:
    return ", ".join(items) or "none"
