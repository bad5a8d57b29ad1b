"""JSON of results, which may hold NumPy's arrays and numbers, infinities and nan."""

from __future__ import annotations

import json
import math
from typing import Any


def json_text(value: object, indent: int | None = None) -> str:
    """Strict JSON: arrays are lists, and what is infinite or undefined is null, for JSON has no words for them."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
