"""The camera as programs see it that nobody here wrote: MAVSDK as client and as autopilot, MAVProxy."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from dappled.flight import flight_report
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import free_port
from tests.simulated.vehicle import VehicleProcess
from tests.system.flying import Flying, flying, settings_of
from tests.system.peers.mavproxy import PYTHON, MavProxy
from tests.waiting import eventually

pytestmark = [
    pytest.mark.peers,
    pytest.mark.alone,
    pytest.mark.skipif(not PYTHON.exists(), reason="MAVSDK and MAVProxy are not set up: run `make peers`"),
]
PEERS = Path(__file__).parent / "peers"


@dataclass
class Camera:
    """A daemon in front of a simulated EOS 450D, with one link for an autopilot and one for a ground station."""

    flying: Flying

    def port(self, link: int) -> int:
        return self.flying.service.parts.links.port(link)

    def iso(self) -> str:
        """As the body has it."""
        return next(str(one["value"]) for one in self.flying.service.health()["settings"] if one["name"] == "CAM_ISO")

    def shots(self) -> dict[str, int]:
        counts: dict[str, int] = self.flying.service.health()["shots"]
        return counts


@pytest.fixture
def camera(tmp_path: Path) -> Iterator[Camera]:
    with SimulatedBody.start(BodyOptions(picture="pattern:200000:CR2")) as body:
        links = ["udpin:127.0.0.1:0", "udpin:127.0.0.1:0"]
        with flying(settings_of(tmp_path, camera={"port": body.port}, mavlink={"url": links})) as daemon:
            daemon.until_ready()
            yield Camera(daemon)


def run(script: str, folder: Path, *arguments: object) -> subprocess.Popen[bytes]:
    """A peer's script in a process of its own, its caches in `folder`."""
    return subprocess.Popen(
        [str(PYTHON), "-W", "ignore", str(PEERS / script), *map(str, arguments)],
        stdin=subprocess.PIPE,
        env={**os.environ, "HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")},
    )


@pytest.mark.long
@pytest.mark.parametrize("through_the_autopilot", [False, True])
def test_mavsdk_as_client(camera: Camera, tmp_path: Path, through_the_autopilot: bool) -> None:
    """On a link of its own, and through the autopilot, which forwards between its ports as ArduPilot does."""
    earlier = [camera.flying.shoot().shot.index for _ in range(2)]
    radio = free_port()
    autopilot = VehicleProcess.start(
        f"udpout:127.0.0.1:{camera.port(0)}",
        seed=1,
        start_monotonic_ns=time.monotonic_ns(),
        more=["--forward", f"--url=udpin:127.0.0.1:{radio}"],
    )
    port = radio if through_the_autopilot else camera.port(1)
    client = run("mavsdk_client.py", tmp_path, port, tmp_path / "said.json")
    try:
        assert client.wait(90) == 0
    finally:
        client.kill()
        client.communicate()
        autopilot.stop()
    said = json.loads((tmp_path / "said.json").read_text())
    assert (said["vendor"], said["model"]) == ("Canon Inc.", "Canon EOS 450D")
    assert min(said["resolution"]) > 1000
    assert all(said["settings"].values())
    assert "200" in said["iso choices"]
    assert said["storage"] == "FORMATTED"
    done = ("set iso", "photo", "interval", "stop", "mode", "reset")
    assert {name: said[name] for name in done} == dict.fromkeys(done, "SUCCESS")
    assert said["mode now"] == "PHOTO"
    assert {said[name] for name in ("video mode", "format", "zoom")} == {"DENIED"}
    assert said["photo info"] == [2, True, "frames/000002.cr2"]
    indices = [index for index, _ in said["heard"]]
    assert indices == sorted(set(indices)), "a photo was reported twice"
    assert all(ok for _, ok in said["heard"])
    assert [index for index, *_ in said["photos"]] == list(range(len(said["photos"])))
    assert set(earlier) | set(indices) == {index for index, *_ in said["photos"]}
    assert camera.shots() == {
        "wished": len(said["photos"]), "safe": len(said["photos"]), "failed": 0, "pending": 0, "refused": 0
    }  # fmt: skip
    assert camera.iso() == "200"


@pytest.mark.long
def test_mavsdk_as_autopilot_whose_system_is_adopted_and_whose_triggers_are_shots(
    camera: Camera, tmp_path: Path
) -> None:
    autopilot = run("mavsdk_autopilot.py", tmp_path, camera.port(0), 7, 3)
    try:
        eventually(lambda: camera.shots()["safe"] == 3, f"three shots: {camera.shots()}", 60)
        shots = list(camera.flying.shots)
        eventually(lambda: len(camera.flying.shots) == 3, f"three shots: {shots}")
    finally:
        autopilot.communicate(timeout=20)
    assert camera.shots()["wished"] == 3
    for pending in camera.flying.shots:
        assert (pending.shot.cause.source, pending.shot.cause.kind) == ("mavlink:7/1", "CAMERA_TRIGGER")
        assert pending.tag is not None
        assert pending.tag.pose.source != "none"
    assert flight_report.balance(camera.flying.service.folder).by_source == {"mavlink:7/1": 3}


@pytest.mark.long
def test_mavproxys_camera_module(camera: Camera, tmp_path: Path) -> None:
    with MavProxy(camera.port(1), tmp_path) as proxy:
        proxy.until(r"loaded \d+ settings")
        proxy.type("camera status")
        proxy.until(r"Canon EOS 450D \(1:100\) streams=0")
        proxy.type("camera info")
        proxy.until(r"recording=no photos=0 available=\d+")
        proxy.type("camera photo")
        proxy.until("IMAGE_START_CAPTURE: ACCEPTED")
        proxy.until("Camera 100 image 0 captured at frames/000000.cr2")
        eventually(lambda: camera.shots()["pending"] == 0, "idle")
        proxy.type("camera photo 0.4 0")
        proxy.until("Camera 100 image 3 captured")
        proxy.type("camera stopphotos")
        proxy.until("IMAGE_STOP_CAPTURE: ACCEPTED")
        eventually(lambda: camera.shots()["pending"] == 0, "idle")
        before = camera.shots()["wished"]
        proxy.type("long DO_DIGICAM_CONTROL 0 0 0 0 1 0 0")
        proxy.until(f"Camera 100 image {before} captured")
        proxy.type("camera param CAM_ISO 400")
        eventually(lambda: camera.iso() == "400", "ISO 400 at the body")
        proxy.type("camera mode photo")
        proxy.type("camera params")
        proxy.until(r"CAM_ISO 400")
    assert camera.shots() == {"wished": before + 1, "safe": before + 1, "failed": 0, "pending": 0, "refused": 0}
