"""Values in a form that JSON can have."""

from __future__ import annotations

import math
from typing import Any


def without_nan(value: Any) -> Any:
    """The same values with None for every number that is NaN or infinite."""
    if isinstance(value, dict):
        return {key: without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
