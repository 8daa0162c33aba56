"""Write the log: with fields to the journal where stderr is the journal, else as plain lines to stderr."""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
import sys
from collections.abc import Mapping

JOURNAL = "/run/systemd/journal/socket"
_PATIENCE_S = 0.05  # a journal that hangs must not delay the shutter, which logs too
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


class JournalHandler(logging.Handler):
    """Sends each record with its fields to the journal (native protocol, one datagram for each record).

    `extra={"dappled": {"frame": 42}}` of a log call becomes a field of its own: DAPPLED_FRAME=42.
    """

    def __init__(self, address: str = JOURNAL) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.settimeout(_PATIENCE_S)
        try:
            self._socket.connect(address)
        except OSError:
            self._socket.close()
            raise

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._socket.send(entry(fields(record)))
        except Exception:  # noqa: BLE001  # like every handler of `logging`: the caller goes on
            self.handleError(record)

    def close(self) -> None:
        self._socket.close()
        super().close()


def fields(record: logging.LogRecord) -> dict[str, str]:
    """A record's journal fields."""
    found = {
        "MESSAGE": record.getMessage(),
        "PRIORITY": str(_PRIORITY.get(record.levelno, 5)),
        "SYSLOG_IDENTIFIER": "dappled",
        "DAPPLED_PART": record.name.removeprefix("dappled."),
        "CODE_FILE": record.pathname,
        "CODE_LINE": str(record.lineno),
    }
    if record.exc_info:
        found["DAPPLED_TRACEBACK"] = logging.Formatter().formatException(record.exc_info)
    for name, value in getattr(record, "dappled", {}).items():
        found[f"DAPPLED_{re.sub('[^A-Z0-9]', '_', str(name).upper())}"] = str(value)
    return found


def entry(found: Mapping[str, str]) -> bytes:
    """Fields in the journal's native protocol: a value with line ends follows its length."""
    parts = []
    for name, value in found.items():
        data = value.encode("utf-8", "replace")
        head = name.encode("ascii")
        if b"\n" in data:
            parts.append(head + b"\n" + struct.pack("<Q", len(data)) + data + b"\n")
        else:
            parts.append(head + b"=" + data + b"\n")
    return b"".join(parts)


def handler(environment: Mapping[str, str] = os.environ, address: str = JOURNAL) -> logging.Handler:
    """The journal's handler when systemd says that stderr is the journal, else one for stderr."""
    if _is_journal(environment.get("JOURNAL_STREAM", "")):
        try:
            return JournalHandler(address)
        except OSError:  # no such socket: plain lines reach the journal too
            pass
    plain = logging.StreamHandler(sys.stderr)
    plain.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    return plain


def _is_journal(stream: str) -> bool:
    try:
        about = os.fstat(2)
    except OSError:
        return False
    return stream == f"{about.st_dev}:{about.st_ino}"
