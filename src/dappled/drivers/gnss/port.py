"""Record a u-blox receiver's serial port: every byte into the telemetry log, and its time marks beside them."""

from __future__ import annotations

import errno
import logging
import select
from datetime import UTC, datetime
from typing import Protocol

from dappled.clock import Clock
from dappled.config.settings import GnssSettings
from dappled.drivers.gnss import recorded
from dappled.drivers.gnss.ubx import Edge, TimeMark, UbxMessage, UbxStream, time_mark
from dappled.drivers.mavlink import LinkError, MavlinkMessage
from dappled.drivers.mavlink.channels import FORBIDDEN, Address, ByteChannel, over_serial, serial_address
from dappled.drivers.utc_choice import RELEASED_NS, Date, UtcBounds, rolled_over, rollovers
from dappled.errors import DappledError, report
from dappled.findings import Code, Finding, Level, Subject, finding, told
from dappled.workers import Loop, OneThread

log = logging.getLogger(__name__)
SETTING = "gnss.port"
_QUIET_S = 0.1
_AGAIN_S = 1.0
_SILENT_NS = 5 * 10**9


class Notebook(Protocol):
    """Where messages are logged; see `recorded.TelemetryNotebook`."""

    def note(self, message: MavlinkMessage) -> None: ...


def address(text: str) -> Address:
    """Parse DEVICE[,BAUD]. Raises LinkError."""
    return serial_address(text, text, SETTING)


def gnss_port(settings: GnssSettings, notebook: Notebook, clock: Clock) -> GnssPort | None:
    """The receiver of the settings; None where they name none. Raises LinkError."""
    if not settings.port:
        return None
    return GnssPort(address(settings.port), "rising" if settings.edge == "rising" else "falling", notebook, clock)


class GnssPort(OneThread):
    """One receiver. A device that is not there, or goes, is waited for."""

    def __init__(self, at: Address, edge: Edge, notebook: Notebook, clock: Clock) -> None:
        self._at, self._edge, self._notebook, self._clock = at, edge, notebook, clock
        self._loop = Loop("gnss", self._run, clock=clock)
        self._unlogged: str | None = None
        self._error: str | None = None
        self._began_ns = clock.monotonic_ns()
        self._heard_ns: int | None = None
        self._message_ns: int | None = None
        self._doubt: Finding | None = None  # of the last mark's date
        self.marks = 0

    def stop(self) -> None:
        """End the thread and close the device."""
        self._loop.stop(2.0)

    def problem(self) -> Finding | None:
        """Why nothing, or nothing of use, is recorded; None while the stream comes."""
        receiver = Subject("GNSS receiver", self._at.host)
        if why := self._error or self._unlogged:
            return finding(Code.GNSS_FAILING, receiver, why=why)
        now_ns = self._clock.monotonic_ns()
        if now_ns - (self._heard_ns or self._began_ns) > _SILENT_NS:
            return finding(Code.GNSS_SILENT, receiver, baud=self._at.port)
        if now_ns - (self._message_ns or self._began_ns) > _SILENT_NS:
            return finding(Code.GNSS_NO_UBX, receiver)
        if self._doubt is not None and self._doubt.level > Level.NOTE:
            return self._doubt
        return None

    def _run(self) -> None:
        while not self._loop.stopping.is_set():
            try:
                channel = over_serial(self._at)
            except LinkError:
                self._wait(f"it is not a serial device; correct {SETTING}")
            except OSError as error:
                self._wait(_sentence(error))
            else:
                self._error = None
                try:
                    self._read(channel)
                except OSError as error:
                    self._wait(_sentence(error))
                finally:
                    channel.close()

    def _wait(self, error: str) -> None:
        self._error = error
        self._clock.wait(self._loop.stopping, _AGAIN_S)

    def _read(self, channel: ByteChannel) -> None:
        """Until the device goes, or the thread is to end."""
        poll = select.poll()
        for descriptor in channel.descriptors():
            poll.register(descriptor, select.POLLIN)
        stream, pending = UbxStream(), b""
        while not self._loop.stopping.is_set():
            data: bytes | None = b""
            if poll.poll(_QUIET_S * 1e3):
                data = channel.read()
            if data:
                pending += data
                self._heard(stream, data)
            whole = len(pending) // recorded.CHUNK * recorded.CHUNK if data else len(pending)
            for at in range(0, whole, recorded.CHUNK):
                self._note(recorded.bytes_message(pending[at : min(at + recorded.CHUNK, whole)]))
            pending = pending[whole:]
            if data is None:
                self._wait("it was unplugged")
                return
        if pending:
            self._note(recorded.bytes_message(pending))

    def _heard(self, stream: UbxStream, data: bytes) -> None:
        self._heard_ns = self._clock.monotonic_ns()
        for message in stream.feed(data):
            self._message_ns = self._heard_ns
            mark = self._dated(message)
            if mark is not None:
                self.marks += 1
                self._note(recorded.mark_message(mark))

    def _dated(self, message: UbxMessage) -> TimeMark | None:
        """A time mark whose date can be true, or would be without a roll-over of the weeks: mended where this machine's
        clock agrees, else in doubt."""
        mark = time_mark(message, self._edge)
        if mark is None:
            return None
        date = UtcBounds.live((self._clock.utc_ns(),)).judge(mark.utc_ns)
        missing, subject = rollovers(mark.utc_ns, RELEASED_NS), Subject("GNSS receiver", self._at.host)
        later = time_mark(message, self._edge, missing)
        if date is Date.TRUE or later is None:
            self._doubt = None
            return mark
        if date is Date.IMPOSSIBLE:
            said = datetime.fromtimestamp(mark.utc_ns // 10**9, UTC)
            self._doubt = finding(Code.TIME_IMPOSSIBLE, subject, utc=f"{said:%Y-%m-%d %H:%M}")
            return None
        mended = date is Date.MENDED
        before, self._doubt = self._doubt, rolled_over(subject, mark.utc_ns, later.utc_ns, mended=mended)
        if mended and before is None:
            log.info("%s", told(self._doubt))
        return later if mended else mark

    def _note(self, message: MavlinkMessage) -> None:
        try:
            self._notebook.note(message)
            self._unlogged = None
        except DappledError as error:  # a full disk: what comes next may have room again
            if self._unlogged is None:
                report(log, "GNSS receiver", error)
            self._unlogged = str(error)


def _sentence(error: OSError) -> str:
    if error.errno == errno.ENOENT:
        return f"there is no such device; plug it in or correct {SETTING}"
    if error.errno in FORBIDDEN:
        return f"no permission to open it; {FORBIDDEN[error.errno]}"
    return f"{error.strerror or error}; plug it in again"
