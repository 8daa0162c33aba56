"""Take test shots with a whole daemon of its own, for `dappled doctor --test-shot` and `--latency`.

A daemon that runs at the same time is not disturbed, but only one of them can hold the camera.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from dappled.clock import Clock, SystemClock
from dappled.config.settings import Settings
from dappled.daemon.navigation import clocks
from dappled.daemon.pipeline.capture import Observer, PendingShot
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.service import Service
from dappled.errors import DappledError
from dappled.workers import Loop

READY_S = 20.0
END_S = 60.0
_LOOK_S = 0.02


@dataclass(frozen=True, slots=True)
class Latency:
    """One shot's times in milliseconds; None where a time could not be measured.

    `wish_to_trigger` is from the capture request to the trigger call, `to_exposure` from the trigger call to the
    opening of the shutter (by the hot shoe), `to_file` from the trigger call to the whole file in memory, `recorded`
    from there to safe on disk.
    """

    wish_to_trigger: float | None
    trigger_call: float | None
    to_exposure: float | None
    to_file: float | None
    recorded: float | None


@contextmanager
def daemon(settings: Settings, sockets: Path, record: Path) -> Iterator[TestShot]:
    """Run a daemon with these settings: its sockets in one folder, its flight in another. Raises DappledError."""
    ours = replace(
        settings,
        record=replace(settings.record, directory=str(record / "flights"), min_free_mb=0),
        publish=replace(settings.publish, slices=f"ipc://{sockets}/s", ask=f"ipc://{sockets}/a"),
        console=replace(settings.console, bind=""),
    )
    clock = SystemClock()
    ended = EndedShots(clock)
    service = Service(ours, observer=ended, clock=clock)
    service.start()
    loop = Loop("test shot", service.run, clock=clock)
    loop.start()
    try:
        yield TestShot(service, ended, clock)
    finally:
        service.ask_to_stop()
        loop.stop(5)
        service.stop()


class EndedShots(Observer):
    """Keeps the shots that have ended."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._shots: dict[int, PendingShot] = {}
        self._changed = threading.Condition()

    def finished(self, pending: PendingShot) -> None:
        """Nothing more is expected of a shot."""
        with self._changed:
            self._shots[pending.shot.index] = pending
            self._changed.notify_all()

    def until_ended(self, index: int, timeout_s: float) -> PendingShot | None:
        """The shot once it has ended; None if that takes longer than `timeout_s`."""
        with self._changed:
            self._clock.wait_for(self._changed, lambda: index in self._shots, timeout_s)
            return self._shots.get(index)


class TestShot:
    """A running daemon to take shots with."""

    def __init__(self, service: Service, ended: EndedShots, clock: Clock) -> None:
        self._service, self._ended, self._clock = service, ended, clock
        self._never = threading.Event()
        self._requests = 0

    @property
    def flight(self) -> Path:
        """The flight's folder."""
        return self._service.folder

    def until_ready(self, timeout_s: float = READY_S) -> None:
        """Wait for the camera. Raises DappledError with the camera's own reason."""
        until_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        while (state := self._service.health()["camera"])["state"] != "ready":
            if self._clock.monotonic_ns() >= until_ns:
                raise DappledError(f"the camera is not ready after {timeout_s:g} s: {state['state']} {state['reason']}")
            self._clock.wait(self._never, _LOOK_S)

    def shoot(self, timeout_s: float = END_S) -> PendingShot:
        """Take one shot and wait for its end. Raises DappledError where it is refused, or does not end."""
        self.until_ready()
        self._requests += 1
        decision = self._service.request(CaptureRequest("doctor", "test shot", self._requests, acknowledged=False))
        if decision.index is None or not decision.accepted:
            raise DappledError(f"the shot was refused: {decision.words}")
        pending = self._ended.until_ended(decision.index, timeout_s)
        if pending is None:
            raise DappledError(f"the shot did not end within {timeout_s:g} s")
        return pending


def latency(pending: PendingShot) -> Latency:
    """The times of one shot."""
    to_exposure = to_file = None
    if pending.fired is not None and pending.tag is not None and pending.tag.time_source.contact:
        called_utc_ns = clocks.called_utc_ns(pending.shot, pending.fired.called_monotonic_ns)
        opened_utc_ns = pending.tag.utc_ns - round((pending.tag.exposure_s or 0.0) / 2 * 1e9)
        to_exposure = (opened_utc_ns - called_utc_ns) / 1e6
    if "trigger to file" in pending.ms and "trigger call" in pending.ms:
        to_file = pending.ms["trigger call"] + pending.ms["trigger to file"]
    return Latency(
        pending.ms.get("wish to trigger"),
        pending.ms.get("trigger call"),
        to_exposure,
        to_file,
        pending.ms.get("record"),
    )
