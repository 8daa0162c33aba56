"""The flight folder: journal, ledger, recorded frames, recovery, checks, index, offload."""

from dappled.flight.chain import digest
from dappled.flight.errors import FlightError, disk_error, disk_errors
from dappled.flight.index import ImageIndex
from dappled.flight.layout import FlightFolder, FlightsLock
from dappled.flight.ledger import LIVE, Ledger, LedgerReader, is_closed
from dappled.flight.recording import Recorder, Recording
from dappled.flight.records import Cause, Frame, Result, Shot, ShotRow, ShotState, Stray, Tag, TimeSource

__all__ = [
    "LIVE", "Cause", "FlightError", "FlightFolder", "FlightsLock", "Frame", "ImageIndex", "Ledger", "LedgerReader",
    "Recorder", "Recording", "Result", "Shot", "ShotRow", "ShotState", "Stray", "Tag", "TimeSource",
    "digest", "disk_error", "disk_errors", "is_closed",
]  # fmt: skip
