"""JSON of results that may hold NumPy arrays and scalars, infinities and NaN."""

from __future__ import annotations

import json
import math
from typing import Any


def json_text(value: object, indent: int | None = None) -> str:
    """Return strict JSON: arrays become lists; infinities and NaN, which JSON lacks, become null."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
