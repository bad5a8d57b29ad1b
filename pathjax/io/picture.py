"""What was rendered as a file, with how it was made."""

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
    """Write an image, `.png` or `.exr`; of the latter also further channels, and what it is of in the header.

    Args:
        channels: name to (H, W).
        scene: what it was loaded from; parameters: what was set, by name.
    Raises:
        InputError: it cannot be written, and nothing is.
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
