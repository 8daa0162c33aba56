"""The loop of the camera's process, with a fake camera and a clock that the test advances."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import pytest

from dappled.clock import RecordedClock
from dappled.drivers.attribution import Claim
from dappled.drivers.camera import (
    Arrival,
    Blob,
    CameraEvent,
    Companion,
    Fired,
    Identity,
    Noticed,
    Setting,
    SettingName,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.child_process import ChannelError, ProcessChannel
from dappled.drivers.gphoto2.intake import Intake
from dappled.drivers.gphoto2.messages import CUT_OFF, Carryover, message_event
from dappled.drivers.gphoto2.process import CameraLoop
from dappled.drivers.gphoto2.protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    CameraNews,
    CaptureComplete,
    CardContents,
    Fetched,
    FileAdded,
    LostError,
    NotOnBusError,
    RefusedError,
    SessionError,
    SettingTurned,
)
from dappled.drivers.gphoto2.settings import GPhoto2Settings
from dappled.findings import Code
from dappled.testing import content, of_shots

FOLDER = "/store/DCIM/100CANON"


def on_card(number: int) -> CameraFile:
    return CameraFile(FOLDER, f"IMG_{number:04d}.CR2")


@dataclass
class FakeCamera:
    """A camera and its card. `coming` is what the next `news` returns; `errors` are raised in turn by the call they
    name."""

    keeps_files: bool = True
    identity: Identity = field(default=Identity("Canon", "450D", "1", "usb:1,2"))
    card: dict[CameraFile, bytes] = field(default_factory=dict)
    coming: list[CameraNews] = field(default_factory=list)
    errors: dict[str, list[SessionError]] = field(default_factory=dict)
    taken: dict[CameraFile, int] = field(default_factory=dict)
    shown: tuple[Setting, ...] = ()
    label: str = "SD"
    triggered: int = 0
    opened: int = 0
    closed: int = 0
    looking: bool = False
    pieces: int = 0
    policies: list[int] = field(default_factory=list)

    def open(self, _settings: GPhoto2Settings, _before: str | None) -> FakeCamera:
        self.policies.append(os.sched_getscheduler(0))
        self._stumble("open")
        self.opened += 1
        return self

    def trigger(self) -> None:
        assert not self.looking  # live view ends before a shot
        self._stumble("trigger")
        self.triggered += 1

    def news(self) -> list[CameraNews]:
        self._stumble("news")
        news, self.coming = self.coming, []
        return news

    def fetch(self, file: CameraFile, _intake: Intake, alive: Callable[[], None]) -> Fetched:
        self._stumble("fetch")
        for _ in range(self.pieces):
            alive()
        return Fetched(Blob.of(self.card[file]), self.taken.get(file))

    def delete(self, file: CameraFile) -> None:
        self._stumble("delete")
        del self.card[file]

    def files(self) -> frozenset[CameraFile]:
        self._stumble("files")
        return frozenset(file for file in self.card if not file.in_memory)

    def contents(self) -> CardContents:
        return CardContents({file: self.about(file) for file in self.files()}, self.label)

    def about(self, file: CameraFile) -> tuple[int, int | None]:
        return len(self.card[file]), self.taken.get(file)

    def settings(self) -> tuple[Setting, ...]:
        self._stumble("settings")
        return self.shown

    def change(self, name: SettingName, value: str) -> None:
        self._stumble("change")
        self.shown = tuple(replace(each, value=value) if each.name == name else each for each in self.shown)

    def preview(self) -> Blob:
        self._stumble("preview")
        self.looking = True
        return Blob.of(b"a picture")

    def end_preview(self) -> None:
        self.looking = False

    def close(self) -> None:
        self.closed += 1

    def changes_card(self, label: str = "SD") -> None:
        self.card, self.taken, self.label = {}, {}, label

    def adds(self, file: CameraFile, data: bytes = b"picture", *, tells: bool = True) -> None:
        self.card[file] = data
        if tells:
            self.coming.append(FileAdded(file))

    def _stumble(self, call: str) -> None:
        if self.errors.get(call):
            raise self.errors[call].pop(0)


class Harness:
    """The loop on one end of a channel, the test on the other."""

    def __init__(self) -> None:
        self.clock = RecordedClock(1_000_000_000_000)
        self.camera = FakeCamera()
        self.carryover = Carryover()
        self.channel, there = ProcessChannel.pair()
        self.loop_channel = ProcessChannel(there)
        self.loop = CameraLoop(self.loop_channel, GPhoto2Settings(), self.camera.open, self.clock)

    def fire(self, *shots: int) -> None:
        for shot in shots:
            self.channel.send({"do": "fire", "shot": shot})

    def turn(self, seconds: float = 0.0, steps: int = 3) -> list[CameraEvent]:
        """Let time pass, then let the loop step; what it said."""
        self.clock.advance(seconds)
        for _ in range(steps):
            self.channel.send({"do": "ping"})  # a waiting command: the loop need not wait for one
            assert self.loop.step()
        events: list[CameraEvent] = []
        pongs = 0
        while (message := self.channel.receive(0.0)) is not None:
            if message.body["is"] == "pong":
                pongs += 1
            elif message.body["is"] == CUT_OFF:
                self.carryover = self.carryover.cut(message.body)
            else:
                events.append(message_event(message))
        assert pongs == steps
        return events


@pytest.fixture
def harness() -> Iterator[Harness]:
    made = Harness()
    yield made
    made.channel.close()
    made.loop_channel.close()


@pytest.fixture
def ready(harness: Harness) -> Harness:
    """A harness whose camera is open."""
    assert [event.state for event in harness.turn() if isinstance(event, StateChanged)] == ["starting", "ready"]
    return harness


def failures(events: list[CameraEvent]) -> dict[int, str]:
    return {event.shot: event.reason for event in events if isinstance(event, ShotFailed)}


def states(events: list[CameraEvent]) -> list[tuple[str, str]]:
    return [(event.state, event.reason) for event in events if isinstance(event, StateChanged)]


def arrivals(events: list[CameraEvent]) -> list[Arrival]:
    return [event for event in events if isinstance(event, Arrival)]


def noticed(events: list[CameraEvent]) -> list[tuple[Code, str | int]]:
    return [(event.finding.code, event.finding.subject.which) for event in events if isinstance(event, Noticed)]


def brought(events: list[CameraEvent]) -> list[tuple[int | None, bytes, bool]]:
    """Shot, bytes, and whether there is a doubt, of each frame and stray."""
    return [(one.shot, content(one), "doubt" in one.facts) for one in arrivals(events)]


def looked(harness: Harness, seconds: float = 0.0) -> list[str]:
    """What became of a look: "picture", or the reason why there is none."""
    harness.channel.send({"do": "look"})
    harness.clock.advance(seconds)
    assert harness.loop.step()
    answers = []
    while (message := harness.channel.receive(0.0)) is not None:
        if message.body["is"] == "live":
            answers.append(message.body.get("refused", "picture"))
        for fd in message.fds:
            assert os.pread(fd, 100, 0) == b"a picture"
            os.close(fd)
    return answers


def test_live_view_shows_a_picture_for_each_look_and_ends_when_nobody_looks(ready: Harness) -> None:
    assert looked(ready) == ["picture"]
    assert looked(ready, 2.9) == ["picture"]
    ready.turn(2.9)
    assert ready.camera.looking
    ready.turn(0.2)
    assert not ready.camera.looking


def test_a_shot_ends_live_view_before_it_fires_and_none_is_read_meanwhile(ready: Harness) -> None:
    assert looked(ready) == ["picture"]
    ready.fire(1)
    assert looked(ready) == ["live view is off while a shot is at the camera"]
    assert ready.camera.triggered == 1  # in the step of its command; the camera asserts that live view was off
    assert looked(ready) == ["live view is off while a shot is at the camera"]
    ready.camera.adds(on_card(1))
    ready.camera.coming.append(CaptureComplete())
    ready.turn()
    assert looked(ready) == ["picture"]


def test_a_body_without_live_view_says_so_and_one_that_is_lost_comes_back(ready: Harness) -> None:
    ready.camera.errors["preview"] = [RefusedError("this body has no live view"), LostError("gone")]
    assert looked(ready) == ["this body has no live view"]
    assert looked(ready) == ["gone"]
    assert [state for state, _ in states(ready.turn(1.0))][-1] == "ready"


def test_absent_camera_is_looked_for_until_it_comes(harness: Harness) -> None:
    harness.camera.errors["open"] = [AbsentError("nothing here"), AbsentError("nothing here")]
    assert states(harness.turn()) == [("starting", ""), ("absent", "nothing here")]
    harness.fire(1)
    assert "nothing here" in failures(harness.turn())[1]
    assert states(harness.turn(1.1, steps=1)) == []  # the same state isn't sent twice
    assert states(harness.turn(1.1)) == [("ready", "")]


def test_a_camera_is_looked_for_when_the_bus_changes_and_else_rarely(harness: Harness) -> None:
    """Each look loads all of libgphoto2's drivers."""
    nodes = [0]
    loop = CameraLoop(
        harness.loop_channel, GPhoto2Settings(), harness.camera.open, harness.clock, bus=lambda: tuple(nodes)
    )
    harness.loop, camera = loop, harness.camera
    camera.errors["open"] = [NotOnBusError("no camera is on USB") for _ in range(4)]
    harness.turn(steps=1)
    assert states(harness.turn(1.1)) == states(harness.turn(1.1)) == []
    assert len(camera.policies) == 1
    nodes.append(1)
    harness.turn(1.1)
    assert len(camera.policies) == 2
    harness.turn(1.1)  # its descriptors come after its name
    assert len(camera.policies) == 3
    camera.errors["open"] = [NotOnBusError("no camera is on USB") for _ in range(4)]
    harness.turn(20.0)  # what the bus doesn't tell
    harness.turn(1.1)
    assert len(camera.policies) == 4
    camera.errors["open"] = [AbsentError("no camera answers at usb:001,002")]  # one that is there, and may answer yet
    nodes.append(2)
    harness.turn(1.1)
    assert states(harness.turn(1.1)) == [("ready", "")]


def test_the_bus_is_looked_at_outside_of_real_time(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    """It took over a second of CPU on a small machine: the kernel killed the process, each second anew."""
    policy = [os.SCHED_RR | os.SCHED_RESET_ON_FORK]
    monkeypatch.setattr(os, "sched_getscheduler", lambda _pid: policy[-1])
    monkeypatch.setattr(os, "sched_setscheduler", lambda _pid, wanted, _param: policy.append(wanted))
    harness.camera.errors["open"] = [AbsentError("no camera is on USB")]
    harness.turn(steps=1)
    harness.turn(60.0)
    assert [one & ~os.SCHED_RESET_ON_FORK for one in harness.camera.policies] == [os.SCHED_OTHER] * 2
    assert policy[-1] == policy[0]


def test_one_shot_is_at_the_camera_at_a_time(ready: Harness) -> None:
    ready.fire(1, 2)
    assert of_shots(ready.turn()) == [(Fired, 1)]
    ready.camera.adds(on_card(1), b"one")
    events = ready.turn()
    assert of_shots(events) == [(Arrival, 1), (Fired, 2)]
    assert content(arrivals(events)[0]) == b"one"
    ready.camera.adds(on_card(2), b"two")
    assert content(arrivals(ready.turn())[0]) == b"two"
    assert ready.camera.triggered == 2


def test_more_than_64_waiting_shots_are_refused(ready: Harness) -> None:
    ready.fire(*range(70))
    assert sorted(failures(ready.turn(steps=1))) == [64, 65, 66, 67, 68, 69]


def test_a_file_without_a_shot_has_none(ready: Harness) -> None:
    ready.camera.adds(on_card(1))
    (arrival,) = arrivals(ready.turn())
    assert arrival.shot is None
    arrival.blob.close()


def test_each_piece_of_a_file_is_a_sign_of_life_before_the_file_is_there(ready: Harness) -> None:
    """A cable of 0.9 MB/s took longer than the process may be silent: it was killed in every shot."""
    ready.camera.pieces = 3
    ready.camera.adds(CameraFile("/store", "IMG_0001.CR2"))
    assert ready.loop.step()
    said = []
    while (message := ready.channel.receive(0.0)) is not None:
        said.append("pong" if message.body["is"] == "pong" else type(message_event(message)).__name__)
        for fd in message.fds:
            os.close(fd)
    assert said.count("pong") == 3
    assert said.index("Arrival") > 2


def test_a_file_announced_twice_comes_once(ready: Harness) -> None:
    ready.camera.adds(on_card(1))
    ready.camera.coming.append(FileAdded(on_card(1)))
    arrivals(ready.turn())[0].blob.close()
    ready.camera.coming.append(FileAdded(on_card(1)))
    assert ready.turn() == []


def test_busy_is_asked_again_every_50_ms_for_busy_s(ready: Harness) -> None:
    ready.camera.errors["trigger"] = [BusyError("busy")] * 2
    ready.fire(1)
    assert of_shots(ready.turn()) == []
    assert of_shots(ready.turn(0.05)) == []
    assert of_shots(ready.turn(0.05)) == [(Fired, 1)]


def test_busy_for_longer_fails(ready: Harness) -> None:
    ready.camera.errors["trigger"] = [BusyError("the camera is too busy")] * 2
    ready.fire(1)
    ready.turn()
    assert "5 s" in failures(ready.turn(5.1))[1]


def test_refused_release_fails_the_shot_only(ready: Harness) -> None:
    ready.camera.errors["trigger"] = [RefusedError("no")]
    ready.fire(1, 2)
    assert of_shots(ready.turn()) == [(ShotFailed, 1), (Fired, 2)]


def test_lost_in_the_trigger_call_fails_the_shot_and_marks_what_follows_as_doubtful(ready: Harness) -> None:
    ready.camera.errors["trigger"] = [LostError("no answer")]
    ready.fire(1, 2)
    events = ready.turn(steps=1)
    assert "may have opened" in failures(events)[1]
    assert states(events)[-1] == ("faulted", "no answer")
    ready.camera.adds(on_card(1), tells=False)  # it had opened
    events = ready.turn(1.0)
    (late,) = arrivals(events)
    assert late.shot == 1
    assert late.facts["doubt"]["facts"] == {"shot": 1}
    late.blob.close()


@pytest.mark.parametrize(("complete", "wait_s"), [(True, 2.6), (False, 10.1)])
def test_a_lost_event_s_file_is_searched_for_on_the_card(ready: Harness, complete: bool, wait_s: float) -> None:
    ready.camera.adds(on_card(1))
    arrivals(ready.turn())[0].blob.close()
    ready.fire(1)
    ready.turn()
    ready.camera.adds(on_card(2), b"found", tells=False)
    if complete:
        ready.camera.coming.append(CaptureComplete())
    ready.turn()
    assert arrivals(ready.turn(wait_s - 0.2)) == []
    (arrival,) = arrivals(ready.turn(0.2))
    assert arrival.shot == 1
    assert arrival.name == "IMG_0002.CR2"
    assert content(arrival) == b"found"


def test_no_file_anywhere_fails_after_file_s(ready: Harness) -> None:
    ready.fire(1)
    ready.turn()
    assert failures(ready.turn(19.9)) == {}
    assert "20 s" in failures(ready.turn(0.2))[1]


def test_a_link_lost_after_the_release_brings_the_file_when_it_is_back(ready: Harness) -> None:
    ready.fire(1, 2)
    ready.turn()
    ready.camera.errors["news"] = [LostError("gone")]
    ready.camera.errors["open"] = [AbsentError("not yet")]
    assert failures(ready.turn()) == {}
    ready.camera.adds(on_card(1), b"kept", tells=False)
    assert states(ready.turn(0.3))[-1] == ("absent", "not yet")
    events = ready.turn(1.1)
    assert of_shots(events) == [(Arrival, 1), (Fired, 2)]
    assert content(arrivals(events)[0]) == b"kept"


def test_a_link_lost_in_mid_transfer_fetches_the_file_once_more(ready: Harness) -> None:
    ready.fire(1)
    ready.turn()
    ready.camera.adds(on_card(1), b"whole")
    ready.camera.errors["fetch"] = [LostError("gone")]
    assert arrivals(ready.turn(steps=1)) == []
    (arrival,) = arrivals(ready.turn(0.3))
    assert arrival.shot == 1
    assert content(arrival) == b"whole"


def test_a_link_that_stays_away_fails_the_shot_and_all_that_wait(ready: Harness) -> None:
    ready.fire(1, 2, 3)
    ready.turn()
    ready.camera.errors["news"] = [LostError("gone")]
    ready.camera.errors["open"] = [AbsentError("pulled")] * 100
    assert failures(ready.turn()) == {}
    ready.turn(10)
    events = ready.turn(10.1)
    assert sorted(failures(events)) == [1, 2, 3]
    assert "pulled" in failures(events)[2]


def test_a_link_lost_with_the_picture_in_memory_fails_the_shot(harness: Harness) -> None:
    harness.camera.keeps_files = False
    harness.turn()
    harness.fire(1)
    harness.turn()
    harness.camera.errors["news"] = [LostError("gone")]
    assert failures(harness.turn()) == {1: "gone"}


def test_a_bad_file_is_fetched_three_times_and_then_left_on_the_card(ready: Harness) -> None:
    ready.fire(1)
    ready.turn()
    ready.camera.adds(on_card(1))
    ready.camera.errors["fetch"] = [RefusedError("announced 7 and sent 6")] * 3
    reason = failures(ready.turn(steps=5))[1]
    assert "announced 7 and sent 6" in reason
    assert f"{FOLDER}/IMG_0001.CR2" in reason
    assert arrivals(ready.turn()) == []


def shot_on(harness: Harness, shot: int, taken_s: int | None, number: int) -> list[CameraEvent]:
    """A shot whose file is announced at once."""
    harness.fire(shot)
    harness.turn()
    file = on_card(number)
    harness.camera.adds(file, b"%d" % number)
    if taken_s is not None:
        harness.camera.taken[file] = taken_s
    return harness.turn()


@pytest.mark.parametrize("hours_wrong", [0, 1, -24])
def test_a_late_file_is_distinguished_from_the_next_shot_s_by_the_body_s_own_time(
    ready: Harness, hours_wrong: int
) -> None:
    def body_s() -> int:
        return ready.clock.monotonic_ns() // 10**9 + 1_700_000_000 + hours_wrong * 3600

    (first,) = arrivals(shot_on(ready, 1, body_s(), 1))
    first.blob.close()
    ready.turn(5.0)
    ready.fire(2)
    ready.turn()
    late, taken = on_card(2), body_s()
    assert list(failures(ready.turn(30.1))) == [2]  # no file, in time
    ready.fire(3)
    ready.turn()
    ready.camera.taken[late] = taken
    ready.camera.adds(late, b"of shot 2")
    (came,) = arrivals(ready.turn())
    assert (came.shot, content(came), "doubt" in came.facts) == (2, b"of shot 2", False)
    ready.camera.taken[on_card(3)] = body_s()
    ready.camera.adds(on_card(3), b"of shot 3")
    (came,) = arrivals(ready.turn())
    assert (came.shot, content(came), "doubt" in came.facts) == (3, b"of shot 3", False)


def test_without_a_body_s_time_a_file_that_may_be_late_is_marked(ready: Harness) -> None:
    ready.fire(1)
    ready.turn()
    ready.turn(30.1)
    (came,) = arrivals(shot_on(ready, 2, None, 1))
    assert came.shot == 2
    assert (came.facts["doubt"]["code"], came.facts["doubt"]["facts"]) == ("frame.rival_shots", {"rival": 1})
    came.blob.close()
    (came,) = arrivals(shot_on(ready, 3, None, 2))
    assert "doubt" not in came.facts  # files come in order
    came.blob.close()


def body_s(harness: Harness) -> int:
    return harness.clock.monotonic_ns() // 10**9 + 4900


def three_shots(harness: Harness) -> None:
    for shot in (1, 2, 3):
        assert brought(shot_on(harness, shot, body_s(harness), shot)) == [(shot, b"%d" % shot, False)]
        harness.turn(2.0)


def made(harness: Harness, number: int, data: bytes, *, tells: bool = True) -> None:
    """The body makes a picture now."""
    harness.camera.taken[on_card(number)] = body_s(harness)
    harness.camera.adds(on_card(number), data, tells=tells)


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("label", ["SD", "another"])
def test_a_card_that_numbers_from_0001_again_brings_its_files(ready: Harness, cut: bool, label: str) -> None:
    three_shots(ready)
    ready.camera.changes_card(label)
    told: list[CameraEvent] = []
    if cut:
        ready.camera.errors["news"] = [LostError("the door is open")]
        told += ready.turn()
        made(ready, 1, b"by hand", tells=False)
        told += ready.turn(0.3)
        assert brought(told) == [(None, b"by hand", False)]
    for number in (2, 3):
        ready.fire(2 + number)
        told += ready.turn()
        made(ready, number, b"again")
        events = ready.turn()
        told += events
        assert brought(events) == [(2 + number, b"again", False)]
        told += ready.turn(2.0)
    assert noticed(told) == [(Code.CARD_CHANGED, "")]


@pytest.mark.parametrize("dated", [(), (1,), (2,)], ids=["neither", "the first", "the second"])
def test_a_known_name_and_size_without_a_time_is_no_proof(ready: Harness, dated: tuple[int, ...]) -> None:
    """libgphoto2 tells no time of a file that was made within 2 s of a listing; the next of its size, on another card,
    was taken for it. The very same bytes are the same picture."""

    def brings(shot: int, data: bytes) -> list[CameraEvent]:
        ready.camera.taken = {on_card(1): body_s(ready)} if shot in dated else {}
        ready.fire(shot)
        ready.turn()
        ready.camera.adds(on_card(1), data)
        return ready.turn()

    assert brought(brings(1, b"one")) == [(1, b"one", False)]
    ready.turn(4.0)
    ready.camera.changes_card("SD")
    events = brings(2, b"two")
    assert (brought(events), noticed(events)) == ([(2, b"two", False)], [(Code.CARD_CHANGED, "")])
    ready.camera.adds(on_card(1), b"two")
    assert brought(ready.turn()) == []


def test_a_camera_that_begins_to_count_anew_loses_no_frame(ready: Harness) -> None:
    """Its names are new, and older than those of the last frames by their numbers."""
    for shot, number in ((1, 41), (2, 42), (3, 1), (4, 2)):
        assert brought(shot_on(ready, shot, body_s(ready), number)) == [(shot, b"%d" % number, False)]
        ready.turn(4.0)


def test_a_card_that_comes_back_brings_nothing_twice(ready: Harness) -> None:
    three_shots(ready)
    first, taken = ready.camera.card, ready.camera.taken
    for card, times in (({}, {}), (first, taken)):
        ready.camera.card, ready.camera.taken = dict(card), dict(times)
        ready.camera.errors["news"] = [LostError("the door is open")]
        ready.turn()
        events = ready.turn(0.3)
        assert (brought(events), noticed(events)) == ([], [(Code.CARD_CHANGED, "")])


def test_older_pictures_on_another_card_stay_there(ready: Harness) -> None:
    three_shots(ready)
    ready.camera.changes_card()
    for number in range(1, 400):
        ready.camera.adds(on_card(number), b"a year ago", tells=False)
        ready.camera.taken[on_card(number)] = body_s(ready) - 365 * 86400
    ready.camera.errors["news"] = [LostError("the door is open")]
    ready.turn()
    events = ready.turn(0.3)
    assert (brought(events), noticed(events)) == ([], [(Code.CARD_CHANGED, "")])


@pytest.mark.parametrize("lost", ["event", "transfer"])
def test_a_picture_by_hand_does_not_become_the_next_shot_s(harness: Harness, lost: str) -> None:
    """Its event was lost, and its shot's too, or the link is cut: both are found when the card is listed."""
    harness.camera.adds(on_card(9999), b"old", tells=False)
    harness.turn()
    three_shots(harness)
    made(harness, 4, b"by hand", tells=False)
    assert brought(harness.turn(8.0)) == []
    harness.fire(4)
    harness.turn()
    made(harness, 5, b"its own", tells=lost == "transfer")
    if lost == "transfer":
        harness.camera.errors["fetch"] = [LostError("cut")]
    events = harness.turn(steps=1)
    events += harness.turn(10.1)
    assert brought(events) == [(None, b"by hand", False), (4, b"its own", False)]


def test_a_picture_whose_event_was_swallowed_is_found_on_the_card(ready: Harness) -> None:
    three_shots(ready)
    made(ready, 4, b"by hand", tells=False)
    assert brought(shot_on(ready, 4, body_s(ready), 5)) == [(4, b"5", False)]
    assert brought(ready.turn(4.5)) == []  # further shots come first
    opened = ready.camera.opened
    assert brought(ready.turn(1.0)) == [(None, b"by hand", False)]
    ready.turn(20.0)
    assert ready.camera.opened == opened + 1  # once


def test_a_shot_is_fired_where_the_body_is_still_closing_for_the_listing(ready: Harness) -> None:
    three_shots(ready)
    made(ready, 4, b"by hand", tells=False)
    assert brought(shot_on(ready, 4, body_s(ready), 5)) == [(4, b"5", False)]
    ready.camera.errors["open"] = [SessionError("busy")]
    assert states(ready.turn(5.5, steps=1)) == []
    ready.fire(5)
    assert [type(event) for event in ready.turn(0.3) if isinstance(event, Fired | Arrival)] == [Fired, Arrival]


def test_what_stays_on_the_card_is_named_at_the_end(ready: Harness) -> None:
    three_shots(ready)
    made(ready, 4, b"by hand", tells=False)
    ready.channel.send({"do": "stop"})
    ready.loop.run()
    events = []
    while (message := ready.channel.receive(0.0)) is not None:
        events.append(message_event(message))
    assert noticed(events) == [(Code.PICTURE_ON_CARD, f"{FOLDER}/IMG_0004.CR2")]


def test_a_process_that_never_saw_the_card_of_the_one_before_says_so_at_the_end(harness: Harness) -> None:
    camera = harness.camera
    camera.errors["open"] = [AbsentError("pulled")]
    before = Carryover(serial=camera.identity.serial)
    harness.loop = CameraLoop(harness.loop_channel, GPhoto2Settings(), camera.open, harness.clock, before)
    harness.turn(steps=1)
    harness.channel.send({"do": "stop"})
    harness.loop.run()
    events = []
    while (message := harness.channel.receive(0.0)) is not None:
        events.append(message_event(message))
    assert noticed(events) == [(Code.CARD_NOT_LISTED, "")]


@pytest.mark.parametrize("owed", [True, False])
def test_a_picture_that_the_count_calls_new_and_the_clock_old_is_not_passed_over(harness: Harness, owed: bool) -> None:
    """The body's clock was set back and the process died before the file was announced."""
    camera, now_ns = harness.camera, harness.clock.monotonic_ns()
    for number, taken_s in ((3, 990), (4, 1000 - 3600)):
        camera.adds(on_card(number), b"picture %d" % number, tells=False)
        camera.taken[on_card(number)] = taken_s
    late = (Claim(4, now_ns - 10**9),) if owed else ()
    seen = ((FOLDER, on_card(3).name, len(camera.card[on_card(3)]), 990, None),)
    before = Carryover(camera.identity.serial, late, (0.0,) * 4, seen, now_ns - 5 * 10**9)
    harness.loop = CameraLoop(harness.loop_channel, GPhoto2Settings(), camera.open, harness.clock, before)
    events = harness.turn()
    name = f"{FOLDER}/{on_card(4).name}"
    assert brought(events) == ([(None, b"picture 4", False)] if owed else [])
    assert noticed(events) == ([] if owed else [(Code.PICTURE_ON_CARD, name)])


@pytest.mark.parametrize("died", [False, True])
def test_an_announced_file_on_a_card_that_was_taken_out_is_named(ready: Harness, died: bool) -> None:
    """Also by the next process, where this one died before it saw the card again."""
    three_shots(ready)
    made(ready, 4, b"by hand")
    ready.camera.errors["fetch"] = [LostError("the door is open")]
    ready.turn(steps=1)
    ready.camera.changes_card()
    if died:
        before = replace(ready.carryover, serial=ready.camera.identity.serial)
        ready.loop = CameraLoop(ready.loop_channel, GPhoto2Settings(), ready.camera.open, ready.clock, before)
    told = noticed(ready.turn(0.3))
    assert told[-1] == (Code.PICTURE_ON_CARD, f"{FOLDER}/IMG_0004.CR2")
    assert told[:-1] == ([] if died else [(Code.CARD_CHANGED, "")])
    assert ready.carryover.cut_off == ()


def test_a_bad_picture_by_hand_does_not_cost_the_shot_s_own(ready: Harness) -> None:
    three_shots(ready)
    ready.fire(4)
    ready.turn()
    made(ready, 4, b"by hand")
    ready.camera.errors["fetch"] = [RefusedError("announced 7 and sent 6")] * 3
    events = ready.turn(steps=5)
    assert noticed(events) == [(Code.PICTURE_ON_CARD, f"{FOLDER}/IMG_0004.CR2")]
    made(ready, 5, b"its own")
    assert brought(ready.turn()) == [(4, b"its own", False)]


RAW_AND_JPEG = (Setting("image_format", "RAW + Large Fine JPEG", ("RAW", "RAW + Large Fine JPEG")),)
RAW, JPEG = on_card(1), CameraFile(FOLDER, "IMG_0001.JPG")


@pytest.mark.parametrize("order", [(RAW, JPEG), (JPEG, RAW)])
def test_raw_and_jpeg_are_one_frame_whichever_comes_first(
    harness: Harness, order: tuple[CameraFile, CameraFile]
) -> None:
    harness.camera.shown = RAW_AND_JPEG
    harness.turn()
    harness.fire(7)
    harness.turn()
    events: list[CameraEvent] = []
    for file in order:
        harness.camera.adds(file, b"\xff\xd8\xffjpeg" if file == JPEG else b"II*\0raw bytes CR")
        events += harness.turn()
    arrival, companion = [event for event in events if isinstance(event, Arrival | Companion)]
    assert isinstance(arrival, Arrival)
    assert isinstance(companion, Companion)
    assert (arrival.shot, arrival.name, companion.shot, companion.name) == (7, RAW.name, 7, JPEG.name)
    arrival.blob.close()
    companion.blob.close()
    assert failures(events) == {}


def test_a_jpeg_whose_raw_file_never_comes_is_a_frame(harness: Harness) -> None:
    harness.camera.shown = RAW_AND_JPEG
    harness.turn()
    harness.fire(7)
    harness.turn()
    harness.camera.adds(JPEG, b"\xff\xd8\xffjpeg")
    assert arrivals(harness.turn()) == []
    (arrival,) = arrivals(harness.turn(2.6))
    assert (arrival.shot, arrival.name) == (7, JPEG.name)
    arrival.blob.close()


def test_finished_without_a_file_fails_soon(ready: Harness) -> None:
    ready.fire(1)
    ready.camera.coming.append(CaptureComplete())
    ready.turn()
    ready.turn(2.6)  # the card is searched
    assert "focus" in failures(ready.turn(2.6))[1]


def test_settings_are_read_at_the_start_and_after_a_change(harness: Harness) -> None:
    harness.camera.shown = (Setting("iso", "100", ("100", "200")),)
    told = [event for event in harness.turn() if isinstance(event, SettingsChanged)]
    assert [event.settings for event in told] == [harness.camera.shown]
    harness.channel.send({"do": "change", "name": "iso", "value": "200"})
    told = [event for event in harness.turn() if isinstance(event, SettingsChanged)]
    assert [(event.settings[0].value, event.refused) for event in told] == [("200", "")]


def test_a_dial_that_is_turned_is_read_at_once(harness: Harness) -> None:
    """Between shots: the body announces it. Without, it would be seen after the next file."""
    harness.camera.shown = (Setting("exposure_mode", "Manual"),)
    harness.turn()
    harness.camera.shown = (Setting("exposure_mode", "AV"),)
    assert not [event for event in harness.turn() if isinstance(event, SettingsChanged)]
    harness.camera.coming.append(SettingTurned())
    told = [event for event in harness.turn() if isinstance(event, SettingsChanged)]
    assert [event.settings for event in told] == [harness.camera.shown]


def test_a_refused_setting_is_reported(ready: Harness) -> None:
    ready.camera.errors["change"] = [RefusedError("the dial stands at M")]
    ready.channel.send({"do": "change", "name": "iso", "value": "200"})
    (told,) = [event for event in ready.turn() if isinstance(event, SettingsChanged)]
    assert "iso" in told.refused
    assert "the dial stands at M" in told.refused


def test_another_body_s_card_is_not_taken_for_new(ready: Harness) -> None:
    ready.camera.errors["news"] = [LostError("gone")]
    ready.turn()
    ready.camera.identity = Identity("Canon", "450D", "2", "usb:1,3")
    ready.camera.adds(on_card(5), tells=False)
    assert arrivals(ready.turn(0.3)) == []


def test_delete_deletes_and_a_refusal_harms_nothing(ready: Harness) -> None:
    ready.camera.adds(on_card(1))
    arrivals(ready.turn())[0].blob.close()
    ready.camera.errors["delete"] = [RefusedError("write protected")]
    delete = {"do": "delete", "folder": FOLDER, "name": "IMG_0001.CR2"}
    ready.channel.send(delete)
    assert ready.turn() == []
    assert ready.camera.card
    ready.channel.send(delete)
    assert ready.turn() == []
    assert not ready.camera.card


def test_a_name_used_again_after_deletion_is_a_new_file(ready: Harness) -> None:
    for data in (b"first", b"second"):
        ready.camera.adds(on_card(1), data)
        assert content(arrivals(ready.turn())[0]) == data
        ready.channel.send({"do": "delete", "folder": FOLDER, "name": "IMG_0001.CR2"})
        ready.turn()


def test_a_body_that_is_gone_when_its_card_is_searched_is_reported_as_absent(ready: Harness) -> None:
    ready.fire(1)
    ready.turn()
    ready.camera.errors["open"] = [AbsentError("nothing here")]
    assert states(ready.turn(10.1, steps=1)) == [("absent", "nothing here")]
    assert states(ready.turn(1.1)) == [("busy", "")]


def test_stop_closes_the_camera(ready: Harness) -> None:
    ready.channel.send({"do": "stop"})
    ready.loop.run()
    assert ready.camera.closed == ready.camera.opened


def test_the_parent_s_end_closes_the_camera(ready: Harness) -> None:
    ready.channel.close()
    with pytest.raises(ChannelError):
        ready.loop.run()
    assert ready.camera.closed == 1


def test_an_unknown_command_ends_the_process(ready: Harness) -> None:
    ready.channel.send({"do": "dance"})
    with pytest.raises(ChannelError, match="dance"):
        ready.loop.step()
