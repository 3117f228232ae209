"""Numbers of XML attributes."""

from __future__ import annotations

import numpy as np


def numbers(text: str | None, count: int) -> np.ndarray | None:
    """``count`` finite numbers of an attribute, or None."""
    try:
        values = np.array([float(x) for x in (text or "").split()])
    except ValueError:
        return None
    return values if len(values) == count and np.all(np.isfinite(values)) else None
