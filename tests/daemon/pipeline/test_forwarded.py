"""One request, one shot, where a ground station's broadcast reaches the camera and the autopilot, which executes it."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from dappled.clock import RecordedClock
from dappled.daemon.pipeline.repeats import FORWARDED_NS, CaptureRequest
from dappled.daemon.pipeline.shutter import Shutter
from dappled.drivers.mavlink import mavlink
from tests.daemon.fakes import FakeSink
from tests.simulated.personality import CameraPort, CameraTriggers

WINDOW_S = FORWARDED_NS / 1e9
START, DIGICAM = "IMAGE_START_CAPTURE", "DO_DIGICAM_CONTROL"
VEHICLE = "mavlink:1/1"


@dataclass
class Airfield:
    """A shutter, an autopilot with these cameras (ours is the first), and messages by when they arrive."""

    personality: str = "ardupilot"
    cameras: tuple[CameraPort, ...] = (CameraPort(),)
    inbox: list[tuple[float, int, CaptureRequest]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = RecordedClock(10**18, 10**18 - 10**9)
        self.sink = FakeSink()
        self.shutter = Shutter(self.sink, self.clock, next_index=0, capacity=1000)
        self.autopilot = CameraTriggers(self.personality, self.cameras)

    def deliver(self, at_s: float, request: CaptureRequest) -> None:
        self.inbox.append((at_s, len(self.inbox), request))

    def broadcast(self, at_s: float, source: str, kind: str, sequence: int | None, *, direct_s: float | None) -> None:
        """A station's message for one photograph, `direct_s` on its way to the camera; None: it is lost on the way."""
        if direct_s is not None:
            acknowledged = kind == START
            request = CaptureRequest(source, kind, sequence, 0, 0, acknowledged=acknowledged, broadcast=True)
            self.deliver(at_s + direct_s, request)

    def executes(self, at_s: float, *, arrives_s: float | None) -> None:
        """The autopilot triggers its cameras; what it sends arrives then. None: it is lost."""
        for message in self.autopilot.trigger(round(at_s * 1e6), 10**15 + round(at_s * 1e6)):
            if arrives_s is None:
                continue
            kind = message.get_type()
            if kind == "COMMAND_LONG" and message.target_component in (0, 100):
                number = round(message.param4) if message.command == mavlink.MAV_CMD_IMAGE_START_CAPTURE else None
                name = START if number is not None else DIGICAM
                self.deliver(at_s + arrives_s, CaptureRequest(VEHICLE, name, number, 0, 0, autopilot=True))
            elif kind == "CAMERA_TRIGGER":
                fact = CaptureRequest(
                    VEHICLE, kind, message.seq, 0, 0, acknowledged=False, time_us=message.time_usec, autopilot=True
                )
                self.deliver(at_s + arrives_s, fact)

    def run(self) -> int:
        """Let everything arrive; the number of shots."""
        now_s = 0.0
        for at_s, _, request in sorted(self.inbox, key=lambda one: one[:2]):
            self.clock.advance(at_s - now_s)
            now_s = at_s
            self.shutter.request(request)
        return len(self.sink.fired)


@pytest.mark.parametrize("kind", [START, DIGICAM])
@pytest.mark.parametrize("first", ["camera", "autopilot"])
@pytest.mark.parametrize(
    ("personality", "wiring"), [("ardupilot", "mavlink"), ("ardupilot", "broadcast"), ("px4", "mavlink")]
)
def test_a_broadcast_that_the_autopilot_executes_is_one_shot(
    kind: str, first: str, personality: str, wiring: str
) -> None:
    field_ = Airfield(personality, (CameraPort(wiring), CameraPort(wiring if wiring == "mavlink" else "wire")))  # type: ignore[arg-type]  # one of the wirings
    field_.broadcast(1.0, "mavlink:255/190", kind, 0, direct_s=0.0 if first == "camera" else 0.1)
    field_.executes(1.0006, arrives_s=0.0)
    assert field_.run() == 1


@st.composite
def _traffic(draw: st.DrawFn) -> list[tuple[float, str, float | None, float | None, bool]]:
    """(after the one before, who asks, its way to the camera, the autopilot's way, whether it is repeated)."""
    way = st.one_of(st.none(), st.floats(0, WINDOW_S / 2 - 0.01))
    return draw(
        st.lists(
            st.tuples(
                st.floats(2 * WINDOW_S + 0.6, 4.0),
                st.sampled_from(["one", "other", "autopilot"]),
                way,
                way,
                st.booleans(),
            ),
            min_size=1,
            max_size=12,
        )
    )


@given(_traffic(), st.sampled_from([START, DIGICAM]), st.sampled_from([("ardupilot", "mavlink"), ("px4", "mavlink")]))
@example([(1.2, "one", 0.0, 0.001, True), (1.2, "autopilot", None, 0.0, False)], START, ("ardupilot", "mavlink"))
def test_requests_and_shots_are_the_same_number(
    traffic: list[tuple[float, str, float | None, float | None, bool]], kind: str, flown: tuple[str, str]
) -> None:
    """Two stations and the autopilot's own triggers, each delayed or lost on each way, some repeated after 0.5 s. A
    request that reaches the camera neither directly nor through the autopilot is none."""
    field_ = Airfield(flown[0], (CameraPort(flown[1]), CameraPort(flown[1])))  # type: ignore[arg-type]  # one of the wirings
    at_s, expected, sequences = 0.0, 0, {"one": 0, "other": 0}
    for gap_s, who, direct_s, through_s, repeated in traffic:
        at_s += gap_s
        if who == "autopilot":
            field_.executes(at_s, arrives_s=through_s)
            expected += through_s is not None
            continue
        sequences[who] += 1
        source = "mavlink:255/190" if who == "one" else "mavlink:254/190"
        heard = direct_s is not None
        repeats = (0.0, 0.5) if repeated and heard and kind == START else (0.0,)  # 203 to all has no number to repeat
        for late_s in repeats:
            field_.broadcast(at_s + late_s, source, kind, sequences[who], direct_s=direct_s if late_s == 0 else 0.0)
            field_.executes(at_s + late_s + 0.0006, arrives_s=through_s if late_s == 0 else 0.001)
        expected += heard or through_s is not None
    assert field_.run() == expected


@given(st.floats(0.0, 0.24), st.permutations(["one", "other", "first", "second"]), st.floats(0, 0.02))
@example(0.238, ["one", "other", "first", "second"], 0.015)
@example(0.238, ["one", "first", "other", "second"], 0.005)
def test_two_stations_at_once_are_two_shots_whatever_arrives_first(
    apart_s: float, order: list[str], step_s: float
) -> None:
    """Two requests, each with the autopilot's version of it: what comes within the window is one shot."""
    field_ = Airfield()
    stations, autopilot = [], []
    for place, name in enumerate(order):
        at_s = 1.0 + place * step_s + (apart_s if place > 1 else 0.0)
        if name in ("one", "other"):
            field_.broadcast(at_s, f"mavlink:25{len(name)}/190", START, 0, direct_s=0.0)
            stations.append(at_s)
        else:
            field_.executes(at_s, arrives_s=0.0)
            autopilot.append(at_s)
    gaps = [abs(asked - told) for asked in stations for told in autopilot]
    assume(all(abs(gap - WINDOW_S) > 1e-6 for gap in gaps))
    both = max(gaps[0], gaps[3]) < WINDOW_S  # the first with the first, the second with the second
    assert field_.run() == 4 - (2 if both else min(gaps) < WINDOW_S)


@pytest.mark.parametrize("slow", [1.0, 1.004, 0.997])
@pytest.mark.parametrize("lost", [(), (3,), (0,), (4, 5)])
@pytest.mark.parametrize("count", [10, 0])
def test_an_interval_that_the_autopilot_runs_too_is_one_interval(
    slow: float, lost: tuple[int, ...], count: int
) -> None:
    """Both run it for 10 photographs; the autopilot's clock is not ours, and each of its lags adds up."""
    clock, sink = RecordedClock(10**18, 10**18 - 10**9), FakeSink()
    shutter = Shutter(sink, clock, next_index=0, capacity=1000)
    autopilot = CameraTriggers()
    asked = mavlink.MAVLink_command_long_message(0, 0, 2000, 0, 0, 2.0, count, 7, 0, 0, 0)
    answers = [autopilot.command(asked, 0, 10**15)]
    request = CaptureRequest("mavlink:255/190", START, 7, 0, 0, broadcast=True)
    assert shutter.start_interval(request, 2.0, count).outcome == "shot"
    for step in range(1, round((10 if count == 0 else 14) * 2.0 / 0.02)):
        clock.advance(0.02)
        answers.append(autopilot.due(round(step * 20_000 * slow), 10**15))
        for message in (m for m in answers.pop(0) if m.get_type() == "COMMAND_LONG"):
            if message.param4 - 1 not in lost:
                shutter.request(CaptureRequest(VEHICLE, START, round(message.param4), 0, 0, autopilot=True))
        shutter.serve()
    if count:
        assert len(sink.fired) == 10
        assert shutter.statistics().interval_s is None
    else:
        assert len(sink.fired) in (9, 10, 11)  # twenty seconds, less or more a lag
        assert shutter.statistics().interval_s == 2.0


def test_an_interval_that_only_the_camera_runs_keeps_its_own_pace() -> None:
    clock, sink = RecordedClock(10**18, 10**18 - 10**9), FakeSink()
    shutter = Shutter(sink, clock, next_index=0, capacity=1000)
    shutter.start_interval(CaptureRequest("mavlink:255/190", START, 7, 0, 0, broadcast=True), 2.0, 5)
    for _ in range(round(9 / 0.05)):
        clock.advance(0.05)
        shutter.serve()
    assert len(sink.fired) == 5


def test_a_broadcast_interval_that_is_sent_again_is_still_its_count() -> None:
    """ArduPilot does not recognise a repeat: it begins again, with a trigger at once."""
    clock, sink = RecordedClock(10**18, 10**18 - 10**9), FakeSink()
    shutter = Shutter(sink, clock, next_index=0, capacity=1000)
    autopilot = CameraTriggers()
    asked = mavlink.MAVLink_command_long_message(0, 0, 2000, 0, 0, 2.0, 10, 7, 0, 0, 0)
    request = CaptureRequest("mavlink:255/190", START, 7, 0, 0, broadcast=True)
    for step in range(round(28 / 0.02)):
        clock.advance(0.02)
        answers = autopilot.due(step * 20_000, 10**15)
        if step in (0, 25):
            shutter.start_interval(request, 2.0, 10)
            answers += autopilot.command(asked, step * 20_000, 10**15)
        for message in answers:
            if message.get_type() == "COMMAND_LONG":
                shutter.request(CaptureRequest(VEHICLE, START, round(message.param4), 0, 0, autopilot=True))
        shutter.serve()
    assert len(sink.fired) == 10


def test_the_autopilots_own_triggers_are_not_an_intervals_shots() -> None:
    """A broadcast interval of 2 s beside a distance trigger of 1.5 s: 10 and 13 photographs, less those within 0.25 s.
    When each trigger counted as the interval's, there were 13 in all."""
    clock, sink = RecordedClock(10**18, 10**18 - 10**9), FakeSink()
    shutter = Shutter(sink, clock, next_index=0, capacity=1000)
    shutter.start_interval(CaptureRequest("mavlink:255/190", START, 7, 0, 0, broadcast=True), 2.0, 10)
    for step in range(1, round(20.4 / 0.05)):
        clock.advance(0.05)
        if step % 30 == 15:
            shutter.request(CaptureRequest(VEHICLE, START, step, 0, 0, autopilot=True))
        shutter.serve()
    assert len(sink.fired) >= 18
    assert shutter.statistics().interval_s is None
