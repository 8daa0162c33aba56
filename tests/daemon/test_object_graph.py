"""The running daemon's parts refer to each other in one direction: no circle of references."""

from __future__ import annotations

import logging
import tempfile
import threading
import types
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.daemon.flight_handover import FlightHandover
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.service import Service
from dappled.mocks.simulation import Simulation, World
from dappled.workers import Loop
from tests.daemon.fakes import CallingObserver
from tests.waiting import eventually

_PARTS = {
    "Service", "MavlinkLinks", "PacketSender", "Component", "OwnAutopilot", "Parameters", "FlightControl", "Shutter",
    "ShotEvents", "Pipeline", "Capture", "Tagging", "Decoding", "DecodeProcess", "LiveDepth", "Answers", "Publisher",
    "LivePictures", "Recording", "Navigation", "Logbook",
}  # fmt: skip
_NOT_WALKED = (str, bytes, int, float, type, types.ModuleType, logging.Logger, weakref.ref, BaseException)


def _inside(value: object) -> Iterator[object]:
    """What a value refers to directly, without the globals of functions and the attributes of classes."""
    if isinstance(value, _NOT_WALKED):
        return
    if isinstance(value, dict):
        yield from value.keys()
        yield from value.values()
    elif isinstance(value, list | tuple | set | frozenset | deque):
        yield from value
    elif isinstance(value, types.MethodType):
        yield value.__self__
        yield value.__func__
    elif isinstance(value, types.BuiltinMethodType):
        yield value.__self__
    elif isinstance(value, types.FunctionType):
        for cell in value.__closure__ or ():
            try:
                yield cell.cell_contents
            except ValueError:  # not filled yet
                continue
        yield from value.__defaults__ or ()
        yield from (value.__kwdefaults__ or {}).values()
    elif isinstance(value, partial):
        yield value.func
        yield value.args
        yield value.keywords
    yield from list(getattr(value, "__dict__", {}).values())
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__weakref__", "__dict__") and hasattr(value, name):
                yield getattr(value, name)


def _is_part(value: object) -> bool:
    """Whether a value is an instance of a class of dappled."""
    return type(value).__module__.split(".")[0] == "dappled"


@dataclass(frozen=True)
class Graph:
    """The instances of dappled's classes that can be reached, by id, and which of them each refers to, with the chain
    of other values between them left out."""

    parts: dict[int, Any]
    edges: dict[int, set[int]]

    @classmethod
    def of(cls, root: object) -> Graph:
        parts, edges, waiting = {id(root): root}, dict[int, set[int]](), [root]
        while waiting:
            part = waiting.pop()
            edges[id(part)] = set()
            seen, between = {id(part)}, list(_inside(part))
            while between:
                value = between.pop()
                if id(value) in seen:
                    continue
                seen.add(id(value))
                if not _is_part(value):
                    between += _inside(value)
                    continue
                edges[id(part)].add(id(value))
                if id(value) not in parts:
                    parts[id(value)] = value
                    waiting.append(value)
        return cls(parts, edges)

    def names(self) -> set[str]:
        return {type(part).__name__ for part in self.parts.values()}

    def circles(self) -> list[list[str]]:
        """The names of the classes in each circle: two parts or more, each of which reaches each other one."""
        reached = {one: self._reached(one) for one in self.edges}
        groups = {frozenset(other for other in reached[one] if one in reached[other]) | {one} for one in reached}
        found = [[self.parts[one] for one in group] for group in groups if len(group) > 1]
        return sorted(sorted(type(part).__name__ for part in group) for group in found if not _own_threads(group))

    def _reached(self, start: int) -> set[int]:
        reached, waiting = set[int](), [start]
        while waiting:
            for other in self.edges[waiting.pop()] - reached:
                reached.add(other)
                waiting.append(other)
        return reached


def _own_threads(group: Iterable[object]) -> bool:
    """The one circle that is allowed: a part and the threads (`Loop`, `Worker`) that it made to run its methods."""
    return sum(not isinstance(part, Loop) for part in group) == 1


def flown(settings: Settings, *, photograph: bool) -> Graph:
    """The parts of a running daemon, after a photograph and all that is made of it."""
    shots: list[PendingShot] = []
    service = Service(settings, observer=CallingObserver(finished=shots.append), after=FlightHandover(settings))
    service.start()
    try:
        eventually(lambda: service.health()["camera"]["state"] == "ready", "the camera is ready")
        service.step()
        if photograph:
            service.request(CaptureRequest("test", "console", 1))
            eventually(lambda: shots, "the shot's end")
        return Graph.of(service)
    finally:
        service.stop()


@pytest.fixture
def sockets() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="dpl-") as folder:  # a socket's path must be short
        yield Path(folder)


@pytest.mark.long
def test_a_simulated_daemon_has_no_circle_of_references(tmp_path: Path, sockets: Path) -> None:
    given = configuration.resolve(Settings())
    given = replace(
        given,
        record=replace(given.record, directory=str(tmp_path / "flights"), min_free_mb=0),
        publish=replace(given.publish, slices=f"ipc://{sockets}/s"),
        decode=replace(given.decode, depth="contrast", depth_to_autopilot=True),
        console=replace(given.console, bind="127.0.0.1:0"),
    )
    with Simulation(World(), given, tmp_path) as settings:
        graph = flown(settings, photograph=True)
    assert graph.circles() == []
    assert {*_PARTS, "GPhoto2Camera"} <= graph.names()


def test_nor_has_one_whose_camera_the_autopilot_fires(tmp_path: Path, sockets: Path) -> None:
    """All parts of a daemon but the gphoto2 driver, and no photograph."""
    given = Settings()
    settings = configuration.resolve(
        replace(
            given,
            camera=replace(
                given.camera, profile="reference-36mm", driver="folder", pickup=str(tmp_path), shutter="autopilot"
            ),
            mask=replace(given.mask, profile="reference-5x5"),
            decode=replace(given.decode, depth="contrast", depth_to_autopilot=True),
            console=replace(given.console, bind="127.0.0.1:0"),
            mavlink=replace(given.mavlink, url=("udpin:127.0.0.1:0",)),
            record=replace(given.record, directory=str(tmp_path / "flights"), min_free_mb=0),
            publish=replace(given.publish, slices=f"ipc://{sockets}/s"),
        )
    )
    graph = flown(settings, photograph=False)
    assert graph.circles() == []
    assert {*_PARTS, "AutopilotLine"} <= graph.names()


def test_a_circle_is_found_through_methods_closures_partials_and_threads() -> None:
    class Part:
        def __init__(self) -> None:
            self.held: object = None

        def act(self) -> None:
            """Nothing."""

    Part.__module__ = "dappled.test"
    ways: list[Callable[[Part], object]] = [
        lambda part: part,
        lambda part: [({"key": part},)],
        lambda part: part.act,
        lambda part: partial(print, part),
        lambda part: lambda: part,
        lambda part: threading.Thread(target=part.act),
    ]
    for way in ways:
        one, other = Part(), Part()
        one.held, other.held = way(other), way(one)
        assert Graph.of(one).circles() == [["Part", "Part"]]
        other.held = None
        assert Graph.of(one).circles() == []
