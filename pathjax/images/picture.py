"""Images for reports: images side by side, and signed values as colours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

GAP = 4
_LEAST_WIDTH = 256


def signed_colors(share: np.ndarray) -> np.ndarray:
    """Map (...,) to (..., 3) linear RGB: white at 0, red from 1 up, blue from -1 down; nan stays nan."""
    share = np.clip(share, -1, 1)[..., None]
    red, blue = np.array([1, 0.05, 0.02]), np.array([0.02, 0.1, 1])
    return 1 - np.abs(share) * (1 - np.where(share > 0, red, blue))


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Join images (H, W, 3) of one size in a row, separated by white; small ones are enlarged by whole factors."""
    height, width, _ = images[0].shape
    zoom = -(-_LEAST_WIDTH // width)
    gap = np.ones((height * zoom, GAP, 3))
    parts = []
    for image in images:
        parts += [gap, np.repeat(np.repeat(image, zoom, 0), zoom, 1)]
    return np.concatenate(parts[1:], 1)
