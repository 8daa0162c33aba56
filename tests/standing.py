"""What a health record says, for tests: sentences and codes of what stands between it and "go"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dappled.daemon.health.standing import in_record
from dappled.findings import above_note, told


def problems(health: Mapping[str, Any]) -> list[str]:
    """As a pilot is told them."""
    return [told(one) for one in above_note(in_record(health))]


def codes(health: Mapping[str, Any]) -> list[str]:
    """Their codes, worst first, then newest."""
    return [one.code.value for one in above_note(in_record(health))]
