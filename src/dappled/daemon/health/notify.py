"""Notify systemd: ready, watchdog, reloading, stopping, and a status line (sd_notify(3))."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping

log = logging.getLogger(__name__)


class Notifier:
    """Sends notifications to the service manager. Without one, every call does nothing.

    The main loop calls `working` each turn; it feeds the watchdog when half of the watchdog's time has passed. When the
    loop hangs, systemd restarts the daemon.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_ns = _watchdog_ns(environment) if address else 0
        self._fed_ns = 0
        self._status = ""

    def ready(self, monotonic_ns: int) -> None:
        """The daemon answers capture requests from now on. Also ends `reloading`."""
        self._fed_ns = monotonic_ns
        self._send("READY=1")

    def reloading(self, monotonic_ns: int) -> None:
        """Settings are being read again, until `ready`."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={monotonic_ns // 1000}")

    def stopping(self) -> None:
        """The daemon is ending."""
        self._send("STOPPING=1")

    def working(self, monotonic_ns: int, *, now: bool = False) -> None:
        """The loop has turned once more. `now`: feed the watchdog in any case, because something longer follows."""
        if self._watchdog_ns and (now or monotonic_ns - self._fed_ns >= self._watchdog_ns // 2):
            self._fed_ns = monotonic_ns
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
