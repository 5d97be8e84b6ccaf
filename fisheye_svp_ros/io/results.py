"""Results for scripts."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fisheye_svp_ros.io.files import write_text


def write_json(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file whole or not at all; a number that is not finite becomes null."""
    write_text(path, json.dumps(_finite(document), indent=2, allow_nan=False) + '\n')


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
