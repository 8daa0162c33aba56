"""What the stream promises: keys by the command line, nothing lost to a killed subscriber, nothing open unasked."""

from __future__ import annotations

import io
import json
import signal
import socket
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from PIL import Image

from dappled.cli import main
from dappled.daemon.camera_protocol.ground_client import GroundClient
from dappled.daemon.stream.subscriber import Subscriber
from dappled.drivers.child_process import DECODER_GOES, VIEWERS_GO
from dappled.mocks.simulation import free_port
from tests.schemas import schema
from tests.waiting import eventually


def watch(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "dappled", "watch", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def flies(folder: Path, *, photographs: bool = True) -> subprocess.Popen[str]:
    """A simulated daemon that photographs until it is ended, or when it is asked."""
    frames = ["--frames", "500"] if photographs else []
    words = ["run", "--simulate", *frames, "--config", "dappled.toml"]
    return subprocess.Popen(
        [sys.executable, "-m", "dappled", *words],
        cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.mark.slow
def test_who_is_on_the_list_receives_and_a_stranger_does_not(tmp_path: Path) -> None:
    for name, folder in (("vehicle", "keys"), ("laptop", "clients"), ("stranger", "keys")):
        assert main(["keys", "make", name, "-o", str(tmp_path / folder)]) == 0
    stream, ask = (f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(2))
    (tmp_path / "dappled.toml").write_text(
        f'[record]\ndirectory = "flights"\n[publish]\nslices = "{stream}"\nask = "{ask}"\n'
        'keys = "keys/vehicle.key_secret"\nclients = "clients"\n'
    )
    endpoint = [stream, "--ask", ask, "--server-key", "keys/vehicle.key"]
    friend = watch(tmp_path, *endpoint, "--keys", "clients/laptop.key_secret", "--count", "2", "--timeout", "120")
    stranger = watch(tmp_path, *endpoint, "--keys", "keys/stranger.key_secret")
    bare = watch(tmp_path, stream)
    daemon = flies(tmp_path)
    try:
        said, complaints = friend.communicate(timeout=120)
        assert friend.returncode == 0, complaints
        assert "2 frames received" in said
        daemon.terminate()  # what was refused in the last minute is told at the end
        assert "not in publish.clients" in daemon.communicate(timeout=120)[1]
    finally:
        daemon.kill()
        daemon.communicate()
        heard = []
        for one in (friend, stranger, bare):
            one.kill()
            heard.append(one.communicate()[0])
    assert heard[1:] == ["", ""]


@pytest.mark.alone  # a machine that is too busy to send drops slices: `dropped` counts them
@pytest.mark.slow
def test_a_subscriber_that_was_killed_and_started_again_ends_with_every_frame(tmp_path: Path, sockets: Path) -> None:
    endpoint = f"ipc://{sockets}/killed"
    (tmp_path / "dappled.toml").write_text(f'[record]\ndirectory = "flights"\n[publish]\nslices = "{endpoint}"\n')

    def received() -> list[int]:
        return sorted(int(path.stem) for path in (tmp_path / "received").glob("*.npy"))

    def all_so_far() -> list[int]:
        frames = received()
        return frames if frames == list(range(len(frames))) else []

    first = watch(tmp_path, endpoint, "--json")
    daemon, again = flies(tmp_path), None
    try:
        assert first.stdout is not None
        assert any(json.loads(line)["topic"] == "slices" for line in first.stdout)
        first.kill()
        again = watch(tmp_path, endpoint, "--from-start", "--save", "received", "--timeout", "120")
        # A daemon that ends waits half a second for the next question: what was missed is answered before.
        eventually(lambda: len(all_so_far()) >= 3, "the second one receives, and what was sent before it began")
        daemon.send_signal(signal.SIGTERM)
        shots = daemon.communicate(timeout=120)[1].splitlines()[-1]
        said, complaints = again.communicate(timeout=120)
        assert again.returncode == 0, complaints
    finally:
        for one in (first, daemon, again):
            if one is not None:
                one.kill()
                with one:  # closes its pipes
                    pass
    frames = len(received())
    assert received() == list(range(frames))
    assert f"{frames} frames received" in said
    assert f" {frames} decoded" in shots


@pytest.mark.alone
@pytest.mark.long  # depth has the lowest priority of all: beside two tests that compute, a map takes over a minute
def test_depth_comes_where_it_is_switched_on(tmp_path: Path, sockets: Path) -> None:
    """As the schema says, with disparities that are known in most of the picture, and a sigma wherever they are."""
    endpoint = f"ipc://{sockets}/depth"
    (tmp_path / "dappled.toml").write_text(
        f'[record]\ndirectory = "flights"\n[publish]\nslices = "{endpoint}"\n[decode]\ndepth = "combined"\n'
        "depth_interval_s = 0\n"
    )
    run = [sys.executable, "-m", "dappled", "run", "--simulate", "--frames", "500", "--config", "dappled.toml"]
    with (tmp_path / "said").open("w") as said:
        daemon = subprocess.Popen(run, cwd=tmp_path, stdout=said, stderr=said)
    try:
        with Subscriber(endpoint, topics=["depth"]) as subscriber:
            message = subscriber.receive(90)
        assert message is not None, (tmp_path / "said").read_text()[-2000:]
        jsonschema.validate(message.header, schema("depth"))
        arrays = message.arrays()
        known = np.isfinite(arrays["disparity"])
        assert arrays["disparity"].shape == arrays["sigma"].shape
        assert known.mean() > 0.5
        assert (arrays["sigma"][known] > 0).all()
        assert message.header["method"] == "combined"
        assert message.header["doubts"] == []
    finally:
        daemon.send_signal(signal.SIGTERM)
        try:
            daemon.wait(30)
        finally:
            daemon.kill()


def memory_scores(parent: int, module: str) -> list[int]:
    """Of a process' children that run a module, rising: those with more go first where memory is short."""
    children = [
        Path("/proc", child)
        for task in Path(f"/proc/{parent}/task").iterdir()
        for child in (task / "children").read_text().split()
    ]
    found = [one for one in children if module.encode() in (one / "cmdline").read_bytes()]
    return sorted(int((one / "oom_score_adj").read_text()) for one in found)


@pytest.mark.slow
def test_a_picture_comes_to_those_who_subscribe_to_it(tmp_path: Path, sockets: Path) -> None:
    """As the schema says, in each pixel of the sensor, while slices go on. Pictures are made at the lowest priority:
    the camera rests meanwhile."""
    endpoint, port = f"ipc://{sockets}/picture", free_port()
    (tmp_path / "dappled.toml").write_text(
        f'[record]\ndirectory = "flights"\n[publish]\nslices = "{endpoint}"\npicture_interval_s = 0\n'
        f'[mavlink]\nurl = "udpin:127.0.0.1:{port}"\n'
    )
    daemon = flies(tmp_path, photographs=False)
    station = GroundClient(f"udpout:127.0.0.1:{port}", system_id=254)
    try:
        with Subscriber(endpoint, topics=["picture", "slices"]) as subscriber, station:
            station.find_camera(120)
            topics: list[str] = []
            wait_s = 0.0
            while "picture" not in topics or "slices" not in topics:
                message = subscriber.receive(wait_s)
                if message is None:  # the camera was not ready, or the picture was dropped
                    (outcome,) = station.capture(1)
                    wait_s = 30 if outcome.ok else 0.5
                    continue
                topics.append(message.topic)
                if message.topic == "picture":
                    jsonschema.validate(message.header, schema("picture"))
                    with Image.open(io.BytesIO(message.body)) as picture:
                        assert picture.size == (message.header["width"], message.header["height"])
                        assert list(picture.size[::-1]) == message.header["frame_shape"]
            assert memory_scores(daemon.pid, "decode_worker") == [DECODER_GOES, VIEWERS_GO]
    finally:
        daemon.terminate()
        daemon.communicate(timeout=120)


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ('[publish]\nslices = "tcp://0.0.0.0:5555"\n', "dappled keys make"),
        (
            '[publish]\nslices = "tcp://0.0.0.0:5555"\nkeys = "none"\nclients = "none"\n',
            "can't be read as a secret key",
        ),
        ('[publish]\nkeys = "none"\n', "go together"),
        ('[console]\nbind = "0.0.0.0:0"\n', "dappled keys token"),
        ('[console]\nbind = "here"\n', "must be host:port"),
    ],
)
def test_what_would_be_open_is_refused_before_anything_begins(
    tables: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "dappled.toml").write_text('[record]\ndirectory = "flights"\n' + tables)
    monkeypatch.chdir(tmp_path)
    assert main(["run", "--config", "dappled.toml"]) == 2
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert words in said
    assert not (tmp_path / "flights").exists()
