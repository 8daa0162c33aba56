"""A whole daemon inside the test's own process, in front of a simulated body that shows any file one likes."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dappled.config import settings as configuration
from dappled.config.schema import TomlSource
from dappled.config.settings import Settings
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision
from dappled.daemon.service import Service
from dappled.flight import LedgerReader, flight_report
from dappled.flight.checks import flight_check
from tests.daemon.fakes import CallingObserver
from tests.standing import problems
from tests.waiting import eventually

DEADLINE_S = 60.0


def settings_of(folder: Path, **tables: Mapping[str, Any]) -> Settings:
    """Settings with record and endpoints in `folder`; the tables given come on top."""
    ours: dict[str, dict[str, Any]] = {
        "camera": {"port": "ptpip:127.0.0.1:1:1"},
        "record": {"directory": str(folder / "flights"), "min_free_mb": 0},
        "publish": {"slices": f"ipc://{folder}/s"},
        "pose": {"wait_ms": 0},
    }
    for name, table in tables.items():
        ours.setdefault(name, {}).update(table)
    return configuration.resolve(configuration.parse(ours, TomlSource("test")))


class Flying:
    """A daemon that runs, and what came down its street."""

    def __init__(self, service: Service, shots: list[PendingShot], settled: list[tuple[int, bool]]) -> None:
        self.service, self.shots, self.settled = service, shots, settled
        self._requests = 0

    @property
    def problems(self) -> str:
        return "\n".join(problems(self.service.health()))

    @property
    def camera(self) -> str:
        state: str = self.service.health()["camera"]["state"]
        return state

    def until_ready(self) -> None:
        eventually(lambda: self.camera == "ready", f"camera ready: {self.problems}")

    def request(self, *, happened: bool = False) -> ShotDecision:
        self._requests += 1
        return self.service.request(CaptureRequest("test", "console", self._requests, happened=happened))

    def shoot(self, *, happened: bool = False) -> PendingShot:
        """One shot to its end. `happened`: something else has fired the camera."""
        self.until_ready()
        decision = self.request(happened=happened)
        assert decision.outcome == "shot", decision.reason
        eventually(lambda: any(one.shot.index == decision.index for one in self.shots), f"shot {decision.index}")
        return next(one for one in self.shots if one.shot.index == decision.index)


@contextmanager
def flying(settings: Settings) -> Iterator[Flying]:
    """The daemon of these settings, at work; in the end it is stopped, and its record must be whole."""
    shots: list[PendingShot] = []
    settled: list[tuple[int, bool]] = []
    service = Service(
        settings,
        observer=CallingObserver(finished=shots.append, settled=lambda index, ok: settled.append((index, ok))),
    )
    service.start()
    folder = service.folder
    loop = threading.Thread(target=service.run, name="daemon")
    loop.start()
    try:
        yield Flying(service, shots, settled)
    finally:
        service.ask_to_stop()
        loop.join(DEADLINE_S)
        service.stop()
    assert not loop.is_alive()
    assert_whole(folder)
    assert len({one.shot.index for one in shots}) == len(shots), "a shot ended twice"


def assert_whole(flight: Path) -> None:
    """`flight check` is good, the counts balance, and every shot is safe or failed."""
    assert flight_check.check(flight).problems == ()
    balance = flight_report.balance(flight)
    assert balance.balanced
    assert balance.closed
    assert balance.open == 0


def told(flight: Path) -> list[str]:
    """The ledger's events, as "kind: text"."""
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        return [f"{event.kind}: {event.words}" for event in ledger.events()]
