"""The main job, end to end: real libgphoto2, real MAVLink over UDP, real ZeroMQ, in processes of their own."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sqlite3
from contextlib import closing
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rawpy

from dappled.cli import main
from dappled.flight import LedgerReader, flight_report
from dappled.flight.checks import flight_check
from tests.schemas import schema
from tests.system.conftest import FRAMES, Flown, dappled, flip, tells_of_no_problem


def test_every_wish_became_one_frame(flown: Flown) -> None:
    balance = flight_report.balance(flown.flight)
    assert (balance.wishes, balance.safe, balance.failed, balance.open) == (FRAMES, FRAMES, 0, 0)
    assert (balance.tagged, balance.decoded, balance.strays) == (FRAMES, FRAMES, 0)
    assert balance.balanced
    assert balance.closed
    (source,) = balance.by_source
    assert source.startswith("mavlink:")


def test_every_byte_is_intact(flown: Flown) -> None:
    report = flight_check.check(flown.flight)
    assert report.problems == ()
    assert report.files == FRAMES
    assert report.telemetry_packets > 100


def test_a_line_was_printed_for_each_frame(flown: Flown) -> None:
    lines = flown.out.splitlines()
    assert len(lines) == FRAMES
    for index, line in enumerate(lines):
        assert line.startswith(f"{index:06d}  IMAGE_START_CAPTURE #")
        for word in ("50 mm", "carriers", "roll", "MB", "decode"):
            assert word in line


def test_a_run_that_goes_well_tells_of_no_problem(flown: Flown) -> None:
    tells_of_no_problem(flown.out, flown.err, FRAMES)


def test_frames_are_raw_files_that_libraw_opens(flown: Flown) -> None:
    for frame in sorted((flown.flight / "frames").glob("*.dng")):
        with rawpy.imread(str(frame)) as raw:
            assert raw.raw_image_visible.shape == (1388, 1844)


def test_the_subscriber_has_what_the_ledger_says(flown: Flown) -> None:
    results = {line.row.shot.index: line.result for line in flight_report.show(flown.flight).lines}
    saved = sorted(flown.received.glob("*.json"))
    assert len(saved) == FRAMES
    for file in saved:
        header = json.loads(file.read_text())
        jsonschema.validate(header, schema("slices"))
        slices = np.load(file.with_suffix(".npy"))
        result = results[header["frame"]]
        assert result is not None
        assert hashlib.sha256(slices.tobytes()).hexdigest() == result.slices_sha256 == header["slices_sha256"]
        assert slices.shape[0] == 13
        assert file.with_suffix(".png").stat().st_size > 1000
    assert "0 lost" in flown.watched


def test_replay_verifies(flown: Flown) -> None:
    done = dappled("replay", str(flown.flight), "--verify")
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"verified {FRAMES} frames: all hashes the same" in done.stdout


def refused(flight: Path, capfd: pytest.CaptureFixture[str]) -> str:
    """What `replay --verify` says of a flight that it refuses."""
    assert main(["replay", str(flight), "--verify"]) == 1
    return capfd.readouterr().err


ANOTHER_MACHINE = """
import platform
platform.machine = lambda: "aarch64"
import numpy as np
from dappled.drivers.raw.darkroom import Darkroom
decode = Darkroom.decode
def rounded(self, *words, **names):
    made = decode(self, *words, **names)
    slices = made.light_field.slices
    noise = np.random.default_rng(1).normal(size=slices.shape)
    slices += ({share} * np.abs(slices).max() * noise).astype(np.float32)
    return made
Darkroom.decode = rounded
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("share", "ends"),
    [(1e-7, (0, "equal within 1e-06 of each frame's largest value")), (1e-5, (1, "the slices differ by "))],
)
def test_replay_verifies_numbers_on_another_machine(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, ends: tuple[int, str]
) -> None:
    """Every process of the replay calls itself an aarch64, and its decoder rounds otherwise."""
    (tmp_path / "sitecustomize.py").write_text(ANOTHER_MACHINE.format(share=share))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    done = dappled("replay", str(flown.flight), "--verify")
    assert done.returncode == ends[0], done.stdout + done.stderr
    assert ends[1] in done.stdout + done.stderr
    assert f"recorded on {platform.machine()}" in done.stdout + done.stderr


def test_one_flipped_byte_of_a_raw_file_is_found(copied: Path, capfd: pytest.CaptureFixture[str]) -> None:
    flip(sorted((copied / "frames").glob("*.dng"))[1], 2_000_000)
    assert "000001.dng" in refused(copied, capfd)


@pytest.mark.parametrize("share", [0.6, *(pytest.param(share, marks=pytest.mark.slow) for share in (0.02, 0.98))])
def test_one_flipped_byte_of_the_telemetry_is_found(
    copied: Path, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    telemetry = copied / "telemetry.tlog"
    flip(telemetry, int(telemetry.stat().st_size * share))
    assert "telemetry" in refused(copied, capfd)


def test_each_missing_or_changed_hash_is_found(copied: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with closing(sqlite3.connect(copied / "flight.sqlite")) as ledger, ledger:
        for index, table in ((0, "poses"), (1, "tags"), (0, "results")):
            ledger.execute(f"DELETE FROM {table} WHERE idx = {index}")  # noqa: S608  # a table's name from this test
        (record,) = ledger.execute("SELECT record FROM results WHERE idx = 1").fetchone()
        changed = {**json.loads(record), "slices_sha256": "0" * 64}
        ledger.execute(
            "UPDATE results SET slices_sha256 = ?, record = ? WHERE idx = 1", ["0" * 64, json.dumps(changed)]
        )
    ledger.close()
    told = refused(copied, capfd)
    for index, what in ((0, "pose"), (1, "tag"), (0, "slices")):
        assert f"frame {index}: the record holds no hash of its {what}" in told
    assert "frame 1: the slices came out different" in told


def test_verify_needs_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path), "--verify"]) == 2
    assert "is not a recorded flight" in capsys.readouterr().err


@pytest.mark.slow
def test_a_new_recipe_writes_beside_the_old_results(copied: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Without a calibration, as if it had been lost: its own run, which verifies, and the flight's own still does."""
    (shipped,) = (copied / "inputs" / "masks").glob("*.toml")
    again = ["--mask", str(shipped), "--camera", "reference-36mm", "--run", "again"]
    assert main(["replay", str(copied), *again]) == 0
    assert "as run again" in capfd.readouterr().err
    with LedgerReader.open(copied / "flight.sqlite") as ledger:
        assert ledger.runs() == {"live": FRAMES, "again": FRAMES}
    for words in (["--run", "again"], []):
        assert main(["replay", str(copied), "--verify", *words]) == 0
    capfd.readouterr()
    assert main(["flight", "show", str(copied)]) == 0
    assert f"again: {FRAMES} frames decoded again" in capfd.readouterr().out
    with closing(sqlite3.connect(copied / "flight.sqlite")) as ledger_file, ledger_file:
        ledger_file.execute("DELETE FROM results WHERE idx = 1 AND run = 'again'")
    ledger_file.close()
    assert main(["replay", str(copied), "--verify", "--run", "again"]) == 1
    assert "frame 1: the record holds no hash of its slices" in capfd.readouterr().err


def test_flight_verbs_read_it(flown: Flown, capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("show", "check", "report"):
        assert main(["flight", verb, str(flown.flight)]) == 0
        capsys.readouterr()
        assert main(["flight", verb, str(flown.flight), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)
    assert main(["flight", "list", str(flown.flight.parent)]) == 0
    assert flown.flight.name in capsys.readouterr().out


def test_flights_are_found_by_the_daemon_s_settings(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "dappled.toml"
    config.write_text(f'[record]\ndirectory = "{flown.flight.parent}"\n', encoding="utf-8")
    assert main(["flight", "list", "--config", str(config)]) == 0
    assert flown.flight.name in capsys.readouterr().out
    assert main(["flight", "report", "--config", str(config)]) == 0
    assert "the counts agree" in capsys.readouterr().out


@pytest.mark.slow
def test_the_flight_decodes_again_on_the_ground(flown: Flown, tmp_path: Path) -> None:
    frame = sorted((flown.flight / "frames").glob("*.dng"))[0]
    calibration = flown.flight / "inputs" / "calibration.toml"
    done = dappled("decode", str(frame), "--mask", "reference-5x5", "--calibration", str(calibration),
                   "-o", str(tmp_path / "f.npz"))  # fmt: skip
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "f.npz") as field:
        assert field["views"].shape[:2] == (5, 5)
        assert field["slices"].dtype == np.complex64
        assert np.isfinite(field["views"]).all()
