"""Whether a body's battery is nearly empty, by the body's own word for it."""

from __future__ import annotations

import re
from collections.abc import Iterable

from dappled.drivers.camera import Setting

LOW_PERCENT = 25
_LOW_WORDS = ("low", "empty", "exhausted", "critical")


def doubt(settings: Iterable[Setting]) -> str | None:
    """A sentence for the pilot where it is nearly empty; None where it is not, or nobody knows."""
    word = next((one.value.strip() for one in settings if one.name == "battery"), "")
    percent = re.fullmatch(r"(\d+)\s*%", word)
    low = int(percent[1]) <= LOW_PERCENT if percent else word.lower() in _LOW_WORDS
    return f"the camera's battery is nearly empty: {word}" if low else None
