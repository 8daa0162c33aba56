"""The JSON Schemas of the wire."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any


def schema(topic: str) -> dict[str, Any]:
    """The schema of a topic's header."""
    text = (resources.files("dappled.daemon.stream") / "schemas" / f"{topic}.json").read_text(encoding="utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded
