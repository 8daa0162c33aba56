"""What drivers make of the mapping that they are given: each takes what it knows, and refuses the rest by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dappled.drivers.camera import CameraError


def only(given: Mapping[str, Any], known: Sequence[str], where: str = "camera") -> None:
    """Raises CameraError for a setting that is not known."""
    unknown = [name for name in given if name not in known]
    if unknown:
        raise CameraError(f"{where} has no setting {unknown[0]!r} for this driver; it knows {', '.join(known)}")


def text_of(given: Mapping[str, Any], name: str) -> str:
    """A setting that is text, "" without one. Raises CameraError."""
    value = given.get(name) or ""
    if not isinstance(value, str):
        raise CameraError(f"camera.{name} must be text, not {value!r}")
    return value


def seconds_of(given: Mapping[str, Any], name: str, default: float) -> float:
    """One of `timeouts`, in seconds. Raises CameraError."""
    table = given.get("timeouts") or {}
    value = table.get(name, default) if isinstance(table, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise CameraError(f"camera.timeouts.{name} must be a number of seconds above 0, not {value!r}")
    return float(value)
