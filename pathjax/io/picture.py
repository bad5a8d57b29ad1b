"""Write a rendered image to a file, with the settings that it was rendered with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pathjax import images
from pathjax.rendering.progressive.until import RenderResult
from pathjax.version import __version__


def write(
    path: Path,
    result: RenderResult,
    channels: Mapping[str, np.ndarray],
    *,
    scene: object,
    parameters: Mapping[str, object],
    seed: int,
) -> None:
    """Write an image as `.png` or `.exr`; EXR files also get the further channels, and the settings in their header.

    Args:
        channels: name to (H, W).
        scene: what the scene was loaded from.
        parameters: values that were set, by name.
    Raises:
        InputError: the file cannot be written; nothing is written then.
    """
    if path.suffix.lower() == ".png":
        images.write_png(path, result.image)
        return
    header = {
        "pathjax.version": __version__,
        "pathjax.scene": str(scene),
        "pathjax.parameters": " ".join(f"{name}={value}" for name, value in parameters.items()),
        "pathjax.spp": result.spp,
        "pathjax.seed": seed,
    }
    images.write_exr(path, {name: result.image[..., i] for i, name in enumerate("RGB")} | dict(channels), header)
