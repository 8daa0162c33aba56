"""The same daemon on real input: a real lenslet photograph with a real flight's poses."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from dappled.cli import main
from tests.schemas import schema
from tests.system.conftest import dappled, until_it_listens


@pytest.fixture
def letters(shared_data: Path) -> Path:
    return shared_data / "lenslet" / "ulf_letters"


def test_carriers_finds_the_published_pitch_untold(letters: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["carriers", str(letters / "letters_ULF_M1.png"), "--mask", "lenslet", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["pitch_px"] == pytest.approx([48.23, 48.23], abs=0.05)
    assert found["law"] == "found"
    orders = {(c["ky"], c["kx"]): c for c in found["carriers"]}
    assert orders[0, 1]["fx"] == pytest.approx(1 / 48.23, rel=1e-3)
    assert orders[1, 0]["fy"] == pytest.approx(1 / 48.23, rel=1e-3)
    assert orders[0, 1]["measured"]["col"] == pytest.approx(orders[0, 1]["col"], abs=0.5)


@pytest.mark.slow
def test_replay_publishes_its_slices_with_the_flight_s_pose(
    letters: Path, shared_data: Path, sockets: Path, tmp_path: Path
) -> None:
    endpoint = f"ipc://{sockets}/letters"
    config = tmp_path / "dappled.toml"
    config.write_text(f'[publish]\nslices = "{endpoint}"\n')
    words = ["watch", endpoint, "--save", str(tmp_path), "--count", "1", "--timeout", "120"]
    watch = subprocess.Popen([sys.executable, "-m", "dappled", *words])
    try:
        until_it_listens(watch)
        done = dappled(
            "replay", str(letters), "--match", "letters_ULF_M1.png", "--mask", "lenslet",
            "--white", str(letters / "letters_ULF_M1_white.png"), "--dark", str(letters / "letters_ULF_M1_dark.png"),
            "--telemetry", str(shared_data / "telemetry" / "dronekit-flight.tlog"),
            "--publish", "--config", str(config),
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert watch.wait(120) == 0
    finally:
        watch.kill()
    header = json.loads((tmp_path / "000000.json").read_text())
    jsonschema.validate(header, schema("slices"))
    assert header["mask"] == "lenslet"
    assert header["pose"]["source"] == "interpolated"
    assert header["pose"]["latitude_deg"] == pytest.approx(-35.36, abs=0.01)
    slices = np.load(tmp_path / "000000.npy")
    assert slices.shape[0] == len(header["carriers"]) > 100
    assert np.abs(slices[0]).mean() > 0.01
