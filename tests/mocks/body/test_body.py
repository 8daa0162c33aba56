from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.body.body import BodyError, BodyOptions, SimulatedBody, pattern, pictures


def test_a_body_listens_obeys_and_ends() -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:jpg", faults=("busy 1",))) as body:
        assert [body.port] == [f"ptpip:127.0.0.1:{port}:{port}" for port in body.tcp_ports]
        assert body.releases == 0
        assert body.card == []
        body.fault("error 2")
        with pytest.raises(BodyError, match="earthquake"):
            body.fault("earthquake")
    with pytest.raises(BodyError):
        body.ask("releases")


def test_a_wire_fires_a_body_that_nobody_is_connected_to_and_not_while_it_works() -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2", delay_s=20.0)) as body:
        assert body.contact()
        assert not body.contact()
        assert body.releases == 1
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2")) as body:
        assert body.contact()
        deadline = time.monotonic() + 60
        while body.card != ["IMG_0001.CR2"]:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_a_body_ends_with_its_input() -> None:
    command = [sys.executable, "-m", "dappled.mocks.body.body", '{"picture": "pattern:1000:jpg"}']
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline().startswith(b"port ")
        process.stdin.close()
        assert process.wait(60) == 0


@pytest.mark.parametrize("options", [BodyOptions(picture="/nowhere.cr2"), BodyOptions("pattern:9:x", faults=("x",))])
def test_a_body_that_can_not_start_says_so(options: BodyOptions, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BodyError, match="did not start"):
        SimulatedBody.start(options)
    assert "body: " in capfd.readouterr().err


def test_patterns_differ_in_every_page_and_shot() -> None:
    first, second = pattern(1, 100_000), pattern(2, 100_000)
    assert len(first) == len(second) == 100_000
    pages = {data[at : at + 4096] for data in (first, second) for at in range(0, 98_304, 4096)}
    assert len(pages) == 48


def test_the_simulated_camera_is_asked_in_its_own_time_and_its_truth_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The glue only, with a renderer of three lines; the real one has tests of its own."""
    asked: list[tuple[object, ...]] = []

    class Camera:
        def __init__(self, *seed: int, **options: object) -> None:
            asked.append((*seed, options))
            self.optics = SimpleNamespace(f_number=7.4)

        def metered(self, f_number: float) -> tuple[float, float]:
            return f_number / 740, 0.5

        def latency_s(self, shot_number: int) -> float:
            return 0.055 if shot_number == 4 else 1.0

        def expose(self, trigger_t_s: float, shot_number: int, *, f_number: float | None) -> SimpleNamespace:
            asked.append((trigger_t_s, shot_number))
            truth = SimpleNamespace(save=lambda path: path.write_bytes(b"truth"))
            assert (tmp_path / "000004.json").exists()  # the shutter opens before the picture is made
            return SimpleNamespace(file=b"raw", name_suffix=".dng", truth=truth)

    renderer = ModuleType("dappled.mocks.scene.masked_camera")
    renderer.__dict__["reference_camera"] = Camera
    monkeypatch.setitem(sys.modules, "dappled.mocks.scene.masked_camera", renderer)
    options = BodyOptions(seed=9, scale=0.5, start_monotonic_ns=1_000_000_000, truth=str(tmp_path), speed_m_s=0.8)
    assert pictures(replace(options, f_number=14.8)).exposure_s == 0.02
    asked.clear()
    source = pictures(options)
    assert source.exposure_s == 0.01
    assert source.expose(3_500_000_000, 4) == (b"raw", "dng")
    assert asked[0][0] == 9
    wanted = asked[0][1]
    assert isinstance(wanted, dict)
    now_t_s = time.time() - wanted.pop("epoch_utc_s")  # the epoch is the wall clock's time at the simulation's start
    assert abs(now_t_s - (time.monotonic_ns() - 1_000_000_000) / 1e9) < 5.0
    path = FlightPath(9, speed_m_s=0.8)
    assert wanted == {"scale": 0.5, "scene": "terrain", "law": "geometric", "path": path, "real": False}
    assert asked[1] == (2.5, 4)
    assert (tmp_path / "000004.npz").read_bytes() == b"truth"
    times = json.loads((tmp_path / "000004.json").read_text())
    assert times == {"trigger_t_s": 2.5, "mid_exposure_t_s": 2.56, "latency_s": 0.055}


def test_a_file_is_shown_every_time(tmp_path: Path) -> None:
    (tmp_path / "a.cr2").write_bytes(b"raw")
    expose = pictures(BodyOptions(picture=str(tmp_path / "a.cr2"))).expose
    assert expose(0, 1) == expose(0, 2) == (b"raw", "cr2")
