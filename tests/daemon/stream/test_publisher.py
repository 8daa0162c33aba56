"""The stream and its questions, over real ZeroMQ sockets."""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import os
import socket
import stat
import threading
import time
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from dappled.config.settings import PublishSettings
from dappled.daemon.stream import publisher, sockets, wire
from dappled.daemon.stream.publisher import UNREAD_STACKS, Publisher, Reply
from dappled.daemon.stream.subscriber import AsyncSubscriber, Subscriber, subscribe
from dappled.daemon.stream.wire import Message, WireError
from dappled.errors import DappledError
from tests.schemas import schema
from tests.waiting import eventually

STACK = np.arange(24, dtype=np.complex64).reshape(2, 3, 4)


def no_answer(_: Mapping[str, Any], reply: Reply) -> None:
    reply(Message("error", {"error": "nothing here"}))


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/s"


@pytest.fixture
def started(endpoint: str) -> Iterator[Publisher]:
    one = Publisher(endpoint, endpoint + ".ask")
    one.start("f", no_answer)
    yield one
    one.stop(0.2)


def receive(subscriber: Subscriber, topic: str, deadline_s: float = 60) -> Message:
    end = time.monotonic() + deadline_s
    while time.monotonic() < end:
        message = subscriber.receive(0.5)
        if message is not None and message.topic == topic:
            return message
    raise AssertionError(f"no {topic} within {deadline_s} s")


def connected(publisher: Publisher, subscriber: Subscriber) -> None:
    """A subscription takes effect some time after connect: publish until something comes."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        publisher.publish("health", {"utc_ns": 0})
        if subscriber.receive(0.05) is not None:
            return
    raise AssertionError("the subscription never took effect")


def test_arrays_arrive_as_sent(started: Publisher, endpoint: str) -> None:
    with Subscriber(endpoint, endpoint + ".ask") as subscriber:
        connected(started, subscriber)
        facts = {"frame": 7, "arrays": [wire.describe_array("slices", STACK, "1")]}
        started.publish("slices", facts, STACK.tobytes())
        message = receive(subscriber, "slices")
        np.testing.assert_array_equal(message.arrays()["slices"], STACK)
        assert (message.header["schema"], message.header["version"]) == ("dappled/slices", 1)
        assert (message.header["seq"], message.header["dropped"], message.header["frame"]) == (0, 0, 7)


def test_seq_counts_each_topic_by_itself(started: Publisher, endpoint: str) -> None:
    with Subscriber(endpoint) as subscriber:
        connected(started, subscriber)
        for frame in range(3):
            started.publish("frame", {"frame": frame})
        assert [receive(subscriber, "frame").header["seq"] for _ in range(3)] == [0, 1, 2]


def test_what_somebody_has_subscribed_to_is_wanted_until_he_leaves(started: Publisher, endpoint: str) -> None:
    assert not started.wanted("picture")
    with Subscriber(endpoint) as usual:
        connected(started, usual)
        assert started.wanted("slices")
        assert not started.wanted("picture"), "a picture is made for those who ask for it"
        with Subscriber(endpoint, topics=["picture"]) as viewer, Subscriber(endpoint, topics=["picture"]) as other:
            eventually(lambda: started.wanted("picture"), "it is known")
            for one in (viewer, other):
                one.listen("picture", False)
            eventually(lambda: not started.wanted("picture"), "both have enough")
            other.listen("", True)  # all topics
            eventually(lambda: started.wanted("picture"), "it is among all")
        eventually(lambda: not started.wanted("picture"), "he is gone")


def test_a_full_queue_drops_previews_before_slices_and_never_frames(endpoint: str) -> None:
    one = Publisher(endpoint, "", capacity=3)
    for topic in ("preview", "slices", "frame", "slices", "frame", "end"):  # not started: all of it waits
        one.publish(topic, {"frame": 0, "utc_ns": 0}, b"x")
    statistics = one.statistics()
    assert {topic: count for topic, count in statistics.dropped.items() if count} == {"slices": 2, "preview": 1}
    assert statistics.waiting == 3
    one.start("f", no_answer)
    with Subscriber(endpoint) as subscriber:
        connected(one, subscriber)
        one.publish("end", {"utc_ns": 0, "shots": {}})
        unsent = receive(subscriber, "end").header["unsent"]
        assert (unsent["slices"], unsent["preview"]) == (2, 1)
    one.stop(0.2)


def test_a_lost_message_is_asked_for_and_had(endpoint: str) -> None:
    asked: list[int] = []

    def answer(request: Mapping[str, Any], reply: Reply) -> None:
        asked.append(request["frame"])
        facts = {"frame": request["frame"], "arrays": [wire.describe_array("slices", STACK, "1")]}
        threading.Thread(target=reply, args=[Message("slices", facts, STACK.tobytes())]).start()

    one = Publisher(endpoint, endpoint + ".ask", capacity=100)
    one.start("f", answer)
    with Subscriber(endpoint, endpoint + ".ask") as subscriber:
        connected(one, subscriber)
        one.publish("slices", {"frame": 40, "arrays": []}, b"")
        assert receive(subscriber, "slices").header["frame"] == 40
        subscriber._next["f"] = 0  # as if the first had been number 0 and lost on the way
        one.publish("slices", {"frame": 41, "arrays": []}, b"")
        assert receive(subscriber, "slices").header["frame"] == 41
        answer_ = receive(subscriber, "slices")
        assert answer_.header["frame"] == 40
        np.testing.assert_array_equal(answer_.arrays()["slices"], STACK)
        assert (asked, subscriber.gaps, subscriber.recovered, subscriber.lost) == ([40], 1, 1, 0)
    one.stop(0.2)


def test_a_late_subscriber_gets_what_it_asks_for_also_at_the_end(endpoint: str) -> None:
    """Three slices go out before anybody listens; `end` says how many there were."""

    def answer(request: Mapping[str, Any], reply: Reply) -> None:
        facts = {"frame": request["frame"], "arrays": [wire.describe_array("slices", STACK, "1")]}
        reply(Message("slices", facts, STACK.tobytes()))

    one = Publisher(endpoint, endpoint + ".ask", capacity=100)
    one.start("f", answer)
    for frame in (40, 41, 42):
        one.publish("slices", {"frame": frame, "arrays": []}, b"")
    eventually(lambda: one.statistics().sent["slices"] == 3, "all are out before anybody listens")
    with Subscriber(endpoint, endpoint + ".ask", from_start=True) as subscriber:
        connected(one, subscriber)
        one.publish("end", {"utc_ns": 0, "shots": {}})
        end = receive(subscriber, "end")
        assert end.header["sent"]["slices"] == 3
        frames = {receive(subscriber, "slices").header["frame"] for _ in range(3)}
        assert frames == {40, 41, 42}
        assert (subscriber.gaps, subscriber.recovered, subscriber.lost, subscriber.waiting_for) == (3, 3, 0, 0)
    one.stop(0.2)


def test_the_start_can_be_asked_for_later(started: Publisher, endpoint: str) -> None:
    started.publish("start", {"utc_ns": 1, "software": "x"})
    with Subscriber(endpoint, endpoint + ".ask", topics=["end"]) as subscriber:
        end = time.monotonic() + 60
        while time.monotonic() < end:
            subscriber.ask({"get": "start"})
            message = subscriber.receive(5)
            assert message is not None
            if message.topic == "start":
                assert message.header["software"] == "x"
                return
    raise AssertionError("start was never answered")


@pytest.mark.parametrize(
    "question",
    [b"", b"{", b"[]", b'{"get": "fish"}', b'{"get": "slices"}', b'{"get": "slices", "frame": "4"}', b"[" * 4000,
     b'{"get": "slices", "frame": 1, "x": NaN}', b'{"get": "slices", "seq": Infinity}',
     b'{"get": "slices", "frame": 1, "flight": 7}',
     b'{"get": "slices", "frame": -1}', b'{"get": "slices", "seq": 99}', b'{"get": "slices", "frame": true}'],
)  # fmt: skip
def test_a_bad_question_gets_one_sentence(started: Publisher, endpoint: str, question: bytes) -> None:
    context = zmq.Context()
    dealer = context.socket(zmq.DEALER)
    dealer.connect(endpoint + ".ask")
    dealer.send(question)
    assert dealer.poll(5000)
    answer = wire.decode(dealer.recv_multipart())
    assert answer.topic == "error"
    jsonschema.validate(answer.header, schema("error"))
    assert started.statistics().refused == 1
    context.destroy(linger=0)


def test_a_question_about_another_flight_is_refused(started: Publisher, endpoint: str) -> None:
    with Subscriber(endpoint, endpoint + ".ask", topics=[]) as subscriber:
        subscriber.ask({"get": "slices", "seq": 0, "flight": "yesterday"})
        message = receive(subscriber, "error")
        assert "flight yesterday is over" in message.header["error"]


def test_a_flood_of_questions_disturbs_nobody(started: Publisher, endpoint: str) -> None:
    """Ten thousand bad questions from a peer that reads no answers; the stream goes on, and all are counted."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    flood = context.socket(zmq.DEALER)
    flood.setsockopt(zmq.RCVHWM, 1)
    flood.connect(endpoint + ".ask")
    with Subscriber(endpoint, endpoint + ".ask") as subscriber:
        connected(started, subscriber)
        for number in range(10_000):
            flood.send(b"fish")
            if number % 1000 == 0:
                started.publish("frame", {"frame": number})
        frames = [receive(subscriber, "frame").header["frame"] for _ in range(10)]
        assert frames == list(range(0, 10_000, 1000))
        eventually(lambda: started.statistics().refused == 10_000, "all are refused and counted")
    context.destroy(linger=0)


class Bodies:
    """Makes bodies of a megabyte, and knows which of them somebody still holds."""

    def __init__(self) -> None:
        self.alive: set[int] = set()
        self.made = 0

    def make(self) -> mmap.mmap:
        body = mmap.mmap(-1, 1 << 20)
        self.alive.add(self.made)
        weakref.finalize(body, self.alive.discard, self.made)
        self.made += 1
        return body


def stops_reading(context: zmq.Context[zmq.Socket[bytes]], endpoint: str, *topics: bytes) -> zmq.Socket[bytes]:
    """A subscriber that keeps as little as ZeroMQ allows, and is never read from."""
    deaf = context.socket(zmq.SUB)
    deaf.setsockopt(zmq.RCVHWM, 1)
    deaf.setsockopt(zmq.RCVBUF, 4096)
    for topic in topics:
        deaf.subscribe(topic)
    deaf.connect(endpoint)
    return deaf


def heard(one: Publisher, deaf: zmq.Socket[bytes], beside: Subscriber) -> None:
    """Publish until the subscription of `deaf` has come. Who reads beside it reads all of that: with a full queue it
    would lose what is published next."""
    until = time.monotonic() + 60
    while not deaf.poll(50):
        assert time.monotonic() < until
        one.publish("slices", {"frame": 0, "arrays": []}, b"")
        receive(beside, "slices")


@pytest.mark.parametrize("before", [0, 1])
def test_a_reader_of_slices_that_stops_keeps_four(endpoint: str, before: int) -> None:
    """Whatever was read before it stopped: that decides how far ZeroMQ has counted."""
    bodies = Bodies()
    mark = PublishSettings().high_water_mark
    one = Publisher(endpoint, "", high_water_mark=mark)
    one.start("f", no_answer)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    deaf = stops_reading(context, endpoint, b"slices")
    with Subscriber(endpoint) as subscriber:
        connected(one, subscriber)
        heard(one, deaf, subscriber)
        for _ in range(before):
            one.publish("slices", {"frame": 0, "arrays": []}, b"")
        for number in range(1, 13):
            one.publish("slices", {"frame": number, "arrays": []}, bodies.make())
            while receive(subscriber, "slices").header["frame"] != number:
                pass
        eventually(lambda: len(bodies.alive) <= 4, "what nobody waits for is freed")
        assert bodies.made == 12
    context.destroy(linger=0)
    one.stop(0.0)


def test_pictures_that_nobody_reads_take_no_place_of_slices(endpoint: str) -> None:
    bodies, one = Bodies(), Publisher(endpoint, "", high_water_mark=PublishSettings().high_water_mark)
    one.start("f", no_answer)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    deaf = stops_reading(context, endpoint, b"slices", b"picture")
    with Subscriber(endpoint) as subscriber:
        connected(one, subscriber)
        heard(one, deaf, subscriber)
        for topic in ("picture", "slices"):
            for number in range(8):
                one.publish(topic, {"frame": number, "arrays": []}, bodies.make())
                one.publish("frame", {"frame": number})
                while receive(subscriber, "frame").header["frame"] != number:
                    pass
        dropped = one.statistics().dropped
        assert dropped["picture"] > 0
        assert dropped["slices"] == 0
    context.destroy(linger=0)
    one.stop(0.0)


def test_readers_that_stop_at_different_times_keep_eight_of_all_together(endpoint: str) -> None:
    """Then slices are dropped, and counted, until somebody reads or is gone; what is small goes on."""
    bodies = Bodies()
    one = Publisher(endpoint, "", high_water_mark=PublishSettings().high_water_mark)
    one.start("f", no_answer)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    readers: list[zmq.Socket[bytes]] = []
    with Subscriber(endpoint) as subscriber:
        connected(one, subscriber)
        number = 0

        def publish() -> None:
            nonlocal number
            number += 1
            one.publish("slices", {"frame": number, "arrays": []}, bodies.make())
            one.publish("frame", {"frame": number})
            while receive(subscriber, "frame").header["frame"] != number:
                pass

        for _ in range(4):
            readers.append(stops_reading(context, endpoint, b"slices"))  # one that nobody holds is closed
            heard(one, readers[-1], subscriber)
            for _ in range(6):
                publish()
        assert one.statistics().dropped["slices"] > 0
        assert len(bodies.alive) <= UNREAD_STACKS + 1  # and the one that is just being sent
        context.destroy(linger=0)

        def none_kept() -> bool:  # ZeroMQ lets go of what a lost peer had when the socket is used again
            one.publish("health", {"utc_ns": 0})
            return not bodies.alive

        eventually(none_kept, "what they kept is freed")
        seen = one.statistics().sent["slices"]
        publish()
        assert one.statistics().sent["slices"] == seen + 1
    one.stop(0.0)


def test_a_reader_over_ipc_gets_more_room_than_the_kernel_s_default(started: Publisher, endpoint: str) -> None:
    """The two ends would wait for each other all the time: a third of the speed is lost."""
    default = Path("/proc/sys/net/core/wmem_default")
    most = Path("/proc/sys/net/core/wmem_max")
    wanted = min(2 * sockets.ROOM_BYTES, 2 * int(most.read_text("ascii")))
    assert wanted > int(default.read_text("ascii"))
    with Subscriber(endpoint) as subscriber:
        connected(started, subscriber)
        eventually(lambda: wanted in rooms(), "the connection has it")


def rooms() -> set[int]:
    """Send buffers of this process' sockets."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                with socket.socket(fileno=os.dup(int(name))) as one:
                    found.add(one.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF))
    return found


def test_what_follows_a_large_message_at_once_is_not_lost(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_PATIENCE_S", "_LARGE_PATIENCE_S"):  # a machine may be slow
        monkeypatch.setattr(publisher, name, 10.0)
    one = Publisher(endpoint, "", capacity=100, high_water_mark=1)
    one.start("f", no_answer)
    rounds, rest = 10, ("preview", "depth", "frame", "health")
    got: list[str] = []
    with Subscriber(endpoint) as subscriber:
        connected(one, subscriber)
        for _ in range(rounds):
            one.publish("slices", {"frame": 1, "arrays": []}, mmap.mmap(-1, 1 << 24))
            for topic in rest:
                one.publish(topic, {"frame": 1, "arrays": []}, b"x")
        while len(got) < rounds * 5:
            message = subscriber.receive(20)
            assert message is not None, "lost"
            if "frame" in message.header:
                got.append(message.topic)
    assert got == ["slices", *rest] * rounds
    one.stop(0.0)


def test_askers_that_never_read_keep_four_answers_of_all_together(endpoint: str) -> None:
    bodies = Bodies()

    def answer(request: Mapping[str, Any], reply: Reply) -> None:
        reply(Message("slices", {"frame": request["frame"], "arrays": []}, bodies.make()))

    one = Publisher(endpoint, endpoint + ".ask")
    one.start("f", answer)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    askers = [context.socket(zmq.DEALER) for _ in range(10)]
    for asker in askers:
        asker.setsockopt(zmq.RCVHWM, 1)
        asker.connect(endpoint + ".ask")
        for frame in range(10):
            asker.send_json({"get": "slices", "frame": frame})
    eventually(lambda: bodies.made == 100 and one.statistics().waiting == 0, "all are answered")
    eventually(lambda: len(bodies.alive) <= 4, "four answers wait")
    assert one.statistics().refused >= 50

    def read() -> bool:
        """All that has come; what a reader's queue had no room for comes after it was read."""
        for asker in askers:
            while asker.poll(0):  # an answer, or why there is none
                message = wire.decode(asker.recv_multipart())
                assert message.topic == "slices" or "ask again later" in message.header["error"]
        return not bodies.alive

    eventually(read, "what was read is freed")
    asker.send_json({"get": "slices", "frame": 10})
    answers = iter(lambda: wire.decode(asker.recv_multipart()) if asker.poll(10_000) else None, None)
    assert "slices" in (message.topic for message in answers if message.header["asked"]["frame"] == 10)
    context.destroy(linger=0)
    one.stop(0.0)


def test_an_answer_that_cannot_be_sent_is_no_loss_of_the_stream(endpoint: str) -> None:
    def answer(_: Mapping[str, Any], reply: Reply) -> None:
        reply(Message("slices", {"frame": float("nan")}))

    one = Publisher(endpoint, endpoint + ".ask")
    one.start("f", answer)
    with Subscriber(endpoint, endpoint + ".ask", topics=[]) as subscriber:
        subscriber.ask({"get": "slices", "frame": 1})
        assert "can't be sent" in receive(subscriber, "error").header["error"]
    assert not any(one.statistics().dropped.values())
    assert one.statistics().refused == 1
    one.stop(0.0)


def test_asyncio_recovers_what_was_lost(endpoint: str) -> None:
    def answer(request: Mapping[str, Any], reply: Reply) -> None:
        facts = {"frame": request["frame"], "arrays": [wire.describe_array("slices", STACK, "1")]}
        reply(Message("slices", facts, STACK.tobytes()))

    async def frames() -> tuple[list[int], int, int]:
        async with AsyncSubscriber(endpoint, endpoint + ".ask", from_start=True) as subscriber:
            got: list[int] = []
            end = time.monotonic() + 60
            while 40 not in got and time.monotonic() < end:
                if not got:
                    one.publish("slices", {"frame": 41, "arrays": []}, b"")
                message = await subscriber.receive(0.1)
                if message is not None and message.topic == "slices":
                    got.append(message.header["frame"])
            return got, subscriber.gaps, subscriber.recovered

    one = Publisher(endpoint, endpoint + ".ask", capacity=100)
    one.start("f", answer)
    one.publish("slices", {"frame": 40, "arrays": []}, b"")
    eventually(lambda: one.statistics().sent["slices"] == 1, "it is out before anybody listens")
    got, gaps, recovered = asyncio.run(frames())
    assert (got[0], 40 in got) == (41, True)
    assert (gaps >= 1, recovered >= 1) == (True, True)
    one.stop(0.2)


def test_async_for_ends_after_end(started: Publisher, endpoint: str) -> None:
    async def topics() -> list[str]:
        got = []
        async for message in subscribe(endpoint, topics=["frame", "end"]):
            got.append(message.topic)
        return got

    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.02):
            started.publish("frame", {"frame": 0})
            started.publish("end", {"utc_ns": 0})

    sender = threading.Thread(target=send)
    sender.start()
    try:
        assert asyncio.run(asyncio.wait_for(topics(), 20))[-1] == "end"
    finally:
        stop.set()
        sender.join()


def test_subscribe_ends_after_end(started: Publisher, endpoint: str) -> None:
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.extend(m.topic for m in subscribe(endpoint, topics=["frame", "end"])))
    reader.start()
    end = time.monotonic() + 60
    while not got and time.monotonic() < end:
        started.publish("frame", {"frame": 0})
        reader.join(0.05)
    started.publish("end", {"utc_ns": 0})
    reader.join(60)
    assert not reader.is_alive()
    assert got[-1] == "end"


def test_a_subscription_asks_for_what_was_sent_before(endpoint: str) -> None:
    def answer(request: Mapping[str, Any], reply: Reply) -> None:
        reply(Message("slices", {"frame": request["frame"], "arrays": []}, b""))

    one = Publisher(endpoint, endpoint + ".ask", capacity=100)
    one.start("f", answer)
    one.publish("slices", {"frame": 40, "arrays": []}, b"")
    eventually(lambda: one.statistics().sent["slices"] == 1, "it is out before anybody listens")
    stream = subscribe(endpoint, from_start=True)
    frames: list[int] = []
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.02):
            one.publish("slices", {"frame": 41, "arrays": []}, b"")

    sender = threading.Thread(target=send)
    sender.start()
    try:
        for message in stream:
            frames.append(message.header["frame"])
            if 40 in frames:
                break
    finally:
        stop.set()
        sender.join()
        one.stop(0.2)
    assert (frames[0], frames[-1]) == (41, 40)
    assert (stream.gaps >= 1, stream.recovered >= 1, stream.lost) == (True, True, 0)


def test_a_subscription_needs_both_key_files() -> None:
    with pytest.raises(DappledError, match="keys and server_key go together"):
        subscribe("tcp://127.0.0.1:5555", keys="laptop.key_secret")


def test_a_thread_that_ended_by_itself_is_told(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Publisher, "_run", lambda _: None)
    one = Publisher(endpoint, "")
    assert one.dead_threads() == []
    one.start("f", no_answer)
    eventually(lambda: one.dead_threads() == ["publisher"], "it is told")
    one.stop(0.0)
    assert one.dead_threads() == []


def test_an_endpoint_in_use_is_refused_and_stays_whole(started: Publisher, endpoint: str) -> None:
    with pytest.raises(WireError, match="in use by another program"):
        Publisher(endpoint, "")
    with Subscriber(endpoint) as subscriber:
        connected(started, subscriber)


def test_a_tcp_port_in_use_is_refused() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(WireError, match="in use by another program"),
    ):
        Publisher(f"tcp://127.0.0.1:{taken.getsockname()[1]}", "")


@given(st.lists(st.binary(max_size=64), max_size=4))
def test_any_parts_are_a_message_or_an_error(parts: list[bytes]) -> None:
    try:
        message = wire.decode(parts)
    except WireError:
        return
    assert isinstance(message.header, dict)


def test_a_body_that_is_too_short_is_named() -> None:
    header = {"arrays": [wire.describe_array("slices", STACK, "1")]}
    with pytest.raises(WireError, match="ends inside"):
        Message("slices", header, STACK.tobytes()[:-1]).arrays()
