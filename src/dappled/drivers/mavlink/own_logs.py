"""Which reader an autopilot's own log has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from dappled import durable
from dappled.drivers.mavlink.log_packets import TriggerLog
from dappled.drivers.utc_choice import UtcBounds
from dappled.errors import DappledError
from dappled.findings import Finding

_READERS = {b"\xa3\x95\x80\x80": "dataflash", b"ULog\x01\x12\x35": "ulog"}  # of ArduPilot, of PX4


class LogReader(Protocol):
    """What reads one kind of log."""

    def packets(
        self, path: Path, report: Callable[[Finding], object], bounds: UtcBounds | None, /
    ) -> Iterator[tuple[int, int, bytes]]:
        """(running number, stamp in µs UTC, packet), in the order of time."""

    def triggers(self, path: Path, cam_idx: int, bounds: UtcBounds | None, /) -> TriggerLog:
        """The triggers of one camera (0 is the first)."""


def own_log(path: Path) -> LogReader | None:
    """The reader of an autopilot's own log, told by the file's first bytes; None for a .tlog.

    Raises DappledError where it can't be read.
    """
    try:
        with open(path, "rb", opener=durable.plain_file) as file:
            begins = file.read(7)
    except OSError as error:
        raise DappledError(f"{path} can't be read: {error.strerror}") from error
    name = next((name for magic, name in _READERS.items() if begins.startswith(magic)), None)
    # loaded for these logs only: one takes a tenth of a second
    return None if name is None else cast("LogReader", import_module(f"dappled.drivers.mavlink.{name}"))
