"""The decode process: it may die, hang or meet nonsense; that costs one sentence, and the next frame is decoded."""

from __future__ import annotations

import hashlib
import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from dappled.clock import RecordedClock
from dappled.daemon.pipeline.decode_process import DecodeProcess, DecodeProcessError, serve
from dappled.drivers.child_process import ProcessChannel, RestartBudget
from dappled.drivers.raw.recipe import Recipe
from dappled.mocks.scene.masked_camera import reference_camera
from dappled.workers import Loop
from tests.waiting import eventually

RECIPE = Recipe("reference-36mm", "reference-5x5")


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("frame") / "good.dng"
    path.write_bytes(reference_camera(1, scale=0.5, scene="white").bench_frame().file)
    return str(path)


@pytest.fixture
def decoder() -> Iterator[DecodeProcess]:
    one = DecodeProcess(RECIPE)
    yield one
    one.close()


def pid(decoder: DecodeProcess) -> int:
    assert decoder._process is not None
    return decoder._process.pid


def test_bad_frames_cost_nothing_but_themselves(decoder: DecodeProcess, frame: str, tmp_path: Path) -> None:
    junk = tmp_path / "junk.dng"
    junk.write_bytes(b"II*\0" + bytes(range(256)) * 100)
    for path in (str(junk), str(tmp_path / "nothing.dng"), str(tmp_path)):
        with pytest.raises(DecodeProcessError) as caught:
            decoder.decode(path, None, None, index=0)
        assert path in str(caught.value)
        assert "\n" not in str(caught.value)
    first = pid(decoder)
    done = decoder.decode(frame, None, None, index=0)
    assert hashlib.sha256(done.body).hexdigest() == done.sha256
    assert done.arrays[0]["shape"][0] == len(done.carriers)
    assert done.preview.startswith(b"\xff\xd8")
    assert pid(decoder) == first


def test_a_picture_holds_each_pixel_of_the_sensor(decoder: DecodeProcess, frame: str) -> None:
    made = decoder.picture(frame, None, None)
    with Image.open(io.BytesIO(made.jpeg)) as picture:
        assert picture.size == made.size == made.frame_shape[::-1]
    assert made.corner == (0, 0)
    assert made.shadow_from == "frame"


def test_a_recipe_that_can_t_work_is_told_at_the_warm_up() -> None:
    decoder = DecodeProcess(Recipe("reference-36mm", "no-such-mask"))
    with pytest.raises(DecodeProcessError, match="no-such-mask"):
        decoder.warm_up()
    decoder.close()


def test_a_worker_that_died_between_two_frames_is_replaced_unseen(decoder: DecodeProcess, frame: str) -> None:
    first, killed = decoder.decode(frame, None, None, index=0), pid(decoder)
    os.kill(killed, signal.SIGKILL)
    assert decoder._process is not None
    decoder._process.wait(60)
    assert decoder.decode(frame, None, None, index=0).sha256 == first.sha256
    assert pid(decoder) != killed


def test_a_worker_that_hangs_is_given_up_and_replaced(frame: str) -> None:
    decoder = DecodeProcess(RECIPE, timeout_s=100.0)
    decoder.warm_up()
    os.kill(pid(decoder), signal.SIGSTOP)
    decoder._timeout_s = 0.2
    with pytest.raises(DecodeProcessError, match="given up"):
        decoder.decode(frame, None, None, index=0)
    decoder._timeout_s = 100.0
    assert decoder.decode(frame, None, None, index=0).sha256
    decoder.close()


@pytest.mark.slow
def test_a_worker_that_keeps_dying_is_not_started_without_end(frame: str) -> None:
    clock = RecordedClock(0)
    budget = RestartBudget(limit=2, window_s=60.0)
    decoder = DecodeProcess(RECIPE, budget=budget, clock=clock)
    for _ in range(2):
        decoder.warm_up()
        os.kill(pid(decoder), signal.SIGKILL)
        assert decoder._process is not None
        decoder._process.wait(60)
    clock.advance(20)
    with pytest.raises(DecodeProcessError, match="keeps crashing: it starts again in 40 s"):
        decoder.decode(frame, None, None, index=0)
    clock.advance(41)
    assert decoder.decode(frame, None, None, index=0).sha256
    decoder.close()


def test_a_flight_that_ends_while_the_decoder_loads_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    decoder = DecodeProcess(RECIPE)
    warm_up = threading.Thread(target=decoder._warm_up)  # as `begin_warm_up`, with an end to wait for
    warm_up.start()
    eventually(lambda: decoder._channel, "it is started")
    decoder.close()
    warm_up.join(60)
    assert caplog.messages == []


def test_close_does_not_wait_for_a_frame_in_hand(frame: str) -> None:
    decoder = DecodeProcess(RECIPE, timeout_s=3600)
    decoder.warm_up()
    os.kill(pid(decoder), signal.SIGSTOP)
    problems: list[Exception] = []

    def decode() -> None:
        try:
            decoder.decode(frame, None, None, index=0)
        except DecodeProcessError as error:
            problems.append(error)

    thread = threading.Thread(target=decode)
    thread.start()
    eventually(decoder._turn.locked, "it is at work")
    decoder.close()
    thread.join(60)
    assert len(problems) == 1
    with pytest.raises(DecodeProcessError, match="stopped"):
        decoder.decode(frame, None, None, index=0)


STARVED = """
import contextlib, os, resource, sys, threading, time
from dappled.daemon.pipeline.decode_process import DecodeProcess, DecodeProcessError, serve
from dappled.drivers.raw.darkroom import Recipe

hogs = []

def exhaust():
    with contextlib.suppress(OSError):
        while True:
            hogs.append(os.open(os.devnull, os.O_RDONLY))

def free():
    while hogs:
        os.close(hogs.pop())

decoder = DecodeProcess(Recipe("reference-36mm", "reference-5x5"))
decoder.warm_up()
first = decoder._process.pid
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
exhaust()
"""


def starved(frame: str, code: str) -> None:
    words = [sys.executable, "-c", f"{STARVED}{code}assert decoder._process.pid == first\ndecoder.close()\n", frame]
    subprocess.run(words, check=True, timeout=100)


@pytest.mark.slow
def test_without_descriptors_a_decoded_frame_waits_for_some(frame: str) -> None:
    starved(
        frame,
        "def free_when_it_waits():\n"
        "    deadline = time.monotonic() + 60\n"
        "    while not decoder._channel.starved and time.monotonic() < deadline:\n"
        "        time.sleep(0.01)\n"
        "    free()\n"
        "threading.Thread(target=free_when_it_waits).start()\n"
        "assert decoder.decode(sys.argv[1], None, None, index=0).carriers\n",
    )


@pytest.mark.slow
def test_without_descriptors_for_long_one_frame_is_not_decoded_and_says_why(frame: str) -> None:
    starved(
        frame,
        "try:\n"
        "    decoder.decode(sys.argv[1], None, None, index=0)\n"
        "except DecodeProcessError as error:\n"
        "    assert sys.argv[1] in str(error) and 'run out of file descriptors' in str(error), error\n"
        "else:\n"
        "    raise AssertionError('it was received')\n"
        "free()\n"
        "assert decoder.decode(sys.argv[1], None, None, index=0).carriers\n",
    )


def test_an_answer_that_is_too_long_is_a_sentence_and_the_next_one_comes() -> None:
    here, there = ProcessChannel.pair()
    bodies = iter([{"carriers": "x" * 200_000}, {"carriers": "x"}])
    worker = Loop("worker", lambda: serve(there, lambda _: (next(bodies), ())))
    worker.start()
    try:
        here.send({"do": "decode", "path": "frame.cr2"})
        answer = here.receive(60.0)
        assert answer is not None
        assert "what frame.cr2 was decoded to can't be reported: a message of" in answer.body["error"]
        here.send({"do": "decode", "path": "frame.cr2"})
        answer = here.receive(60.0)
        assert answer is not None
        assert answer.body == {"carriers": "x"}
    finally:
        here.close()
        assert worker.stop(60.0)
        there.close()
