"""Talk to systemd: the log with its fields to the journal, and notifications of the daemon's state (sd_notify(3)).

Without systemd the log goes to stderr as plain lines, and a notification does nothing.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
import sys
from collections.abc import Mapping

from dappled.shown import LineFormatter, printable

JOURNAL = "/run/systemd/journal/socket"
_PATIENCE_S = 0.05  # a journal that hangs must not delay the shutter, which logs too
log = logging.getLogger(__name__)
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
        "MESSAGE": printable(record.getMessage()),
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
    plain.setFormatter(LineFormatter("%(levelname)s %(name)s: %(message)s"))
    return plain


def _is_journal(stream: str) -> bool:
    try:
        about = os.fstat(2)
    except OSError:
        return False
    return stream == f"{about.st_dev}:{about.st_ino}"


class Notifier:
    """Sends notifications to the service manager. Without one, every call does nothing.

    The main loop calls `working` each turn; it feeds the watchdog when a tenth of the watchdog's time has passed: if
    it were half, a turn longer than the other half would be a hang. When the loop hangs, systemd restarts the daemon;
    while it waits for the disk, `Patience` feeds the watchdog.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_ns = _watchdog_ns(environment) if address else 0
        self.fed_ns = 0
        self._status = ""

    @property
    def listens(self) -> bool:
        """Whether there is one."""
        return bool(self._address)

    def ready(self, monotonic_ns: int) -> None:
        """The daemon answers capture requests from now on. Also ends `reloading`."""
        self.fed_ns = monotonic_ns
        self._send("READY=1")

    def reloading(self, monotonic_ns: int) -> None:
        """Settings are being read again, until `ready`."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={monotonic_ns // 1000}")

    def stopping(self) -> None:
        """The daemon is ending."""
        self._send("STOPPING=1")

    def working(self, monotonic_ns: int, *, now: bool = False) -> None:
        """The loop has turned once more. `now`: feed the watchdog in any case, because something longer follows."""
        if self.watchdog_ns and (now or monotonic_ns - self.fed_ns >= self.watchdog_ns // 10):
            self.fed_ns = monotonic_ns
            self.feed()

    def feed(self) -> None:
        """Feed the watchdog, though the loop has not turned."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """The line of `systemctl status`; sent when it changes."""
        if text != self._status:
            self._status = text
            self._send("STATUS=" + text.replace("\n", " "))

    def _send(self, message: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as one:
                one.sendto(message.encode(), self._address)
        except OSError as error:  # a missing manager must not stop a flight
            log.debug("systemd was not notified of %r: %s", message, error)


def _watchdog_ns(environment: Mapping[str, str]) -> int:
    """The watchdog's time if it is meant for this process; 0 without a watchdog."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0
    usec = environment.get("WATCHDOG_USEC", "")
    return int(usec) * 1000 if usec.isdecimal() else 0
