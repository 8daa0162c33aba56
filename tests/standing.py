"""What a health record or a shot says, for tests: sentences and codes of what stands between it and "go"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dappled.daemon.health.standing import in_record
from dappled.findings import Code, Finding, Subject, above_note, finding, text, told


def problems(health: Mapping[str, Any]) -> list[str]:
    """As a pilot is told them."""
    return [str(told(one)) for one in above_note(in_record(health))]


def codes(health: Mapping[str, Any]) -> list[str]:
    """Their codes, worst first, then newest."""
    return [one.code.value for one in above_note(in_record(health))]


def words(problem: Finding | None) -> str:
    """Of a shot's problem; "" without one."""
    return "" if problem is None else str(text(problem))


def failure(reason: str) -> Finding:
    """Why a shot failed, by a driver's words."""
    return finding(Code.SHOT_FAILED, Subject("shot"), reason=reason)


STRAY = finding(Code.FILE_NO_SHOT, Subject("file"))
