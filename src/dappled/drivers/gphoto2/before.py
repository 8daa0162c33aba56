"""What an earlier process that died leaves to the next one. Read by both sides; no libgphoto2 here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from dappled.drivers.wired.attribution import Claim

LATE = 16


@dataclass(frozen=True, slots=True)
class Before:
    """What an earlier process that died leaves to the next: the body's serial number, the shots that were fired and
    have no file, the body's clock, and the (folder, name) of the files that came last."""

    serial: str | None = None
    late: tuple[Claim, ...] = ()
    offsets_s: tuple[float, ...] = ()
    seen: tuple[tuple[str, str], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    @classmethod
    def of_json(cls, value: Mapping[str, Any]) -> Before:
        """From what `to_json` made."""
        late = tuple(Claim(**each) for each in value["late"])
        seen = tuple((folder, name) for folder, name in value["seen"])
        return cls(value["serial"], late, tuple(value["offsets_s"]), seen)
