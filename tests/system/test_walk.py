"""README's way and the operator's page, word for word, with a simulated Canon EOS 450D in place of the real one."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dappled
from dappled.flight import LedgerReader
from dappled.mocks.simulation import free_port
from dappled.products.opened import OpenedFlight
from tests.system.conftest import dappled as command

README = Path("README.md").read_text(encoding="utf-8")
OPERATING = Path("docs/operating.md").read_text(encoding="utf-8")


def block(after: str) -> str:
    """The first block of commands after some words of README."""
    return README.split(after, 1)[1].split("```sh\n", 1)[1].split("```", 1)[0]


def words(line: str) -> list[str]:
    """The words of a command behind `dappled`, without its comment."""
    (_name, *rest) = shlex.split(line, comments=True)
    return rest


def simulating() -> list[str]:
    """The command with which README replaces the camera."""
    (line,) = re.findall(r"`(dappled run --simulate --config \S+)`", README)
    return words(line)


@pytest.mark.slow
def test_the_readme_leads_to_a_flight_report_with_a_simulated_450d(
    tmp_path: Path, sockets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # where flights are kept without a word about it
    monkeypatch.setenv("PYTHONPATH", str(Path(dappled.__file__).parents[1]), prepend=os.pathsep)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(sockets))
    script = block("container](Containerfile) has what").replace("14550", str(free_port()))
    written, _, rest = script.partition("\nTOML\n")
    subprocess.run(["/bin/sh", "-c", f"{written}\nTOML"], cwd=tmp_path, check=True)
    check, run, trigger, report = (words(line) for line in rest.strip().splitlines())
    assert [line[0] for line in (check, run, trigger, report)] == ["config", "run", "trigger", "flight"]
    checked = command(*check, cwd=tmp_path)
    assert (checked.returncode, checked.stdout) == (0, "dappled.toml: good\n")
    with subprocess.Popen(
        [sys.executable, "-m", "dappled", *simulating()],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stderr is not None
            said = []
            for line in process.stderr:
                said.append(line)
                if line == "camera ready\n":
                    break
            assert said[0] == "simulating a Canon EOS 450D with mask-2, an autopilot and a ground station\n"
            triggered = command(*trigger, cwd=tmp_path)
            assert triggered.returncode == 0, triggered.stderr
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 0, err
    assert out.count(" carriers (calibrated)") == 3, out
    assert not re.search(r"^(caution|stop): ", "".join(said) + err, re.MULTILINE)
    assert err.endswith("3 shots: 3 frames safe, 3 decoded, 0 with a problem\n")
    reported = command(*report, cwd=tmp_path)
    assert reported.returncode == 0, reported.stderr
    assert "3 shots: 3 safe, 0 failed, 0 open" in reported.stdout
    assert "the counts agree" in reported.stdout
    (flight,) = (entry for entry in (tmp_path / "flights").iterdir() if entry.is_dir())
    with LedgerReader.open(flight / "flight.sqlite") as ledger:  # on a busy machine a pose may be late, not the focus
        verdicts = [result.verdict for result in ledger.results().values()]
    assert len(verdicts) == 3
    # Views of mask 2 are 44 px a side: where the ground has little detail so few frames can't tell the focus.
    assert all(found is not None and found.state != "bad" for found in verdicts), verdicts
    recorded = dappled.open(flight)
    assert isinstance(recorded, OpenedFlight)
    views = recorded[0].light_field.field.views
    assert views is not None
    assert np.isfinite(views).all()


def steps(section: str) -> dict[str, list[str]]:
    """The commands of a section of the operator's page, by their verbs, for the folder that its rehearsal speaks of."""
    text = OPERATING.split(f"\n## {section}", 1)[1].split("\n## ", 1)[0].replace("/etc/dappled/", "")
    told = [words(line) for part in text.split("```sh\n")[1:] for line in part.split("```")[0].splitlines()
            if line.startswith("dappled ")]  # fmt: skip
    return {" ".join(line[: 2 if line[0] in ("flight", "config") else 1]): line for line in told}


@pytest.mark.slow
def test_the_operator_s_page_is_rehearsed_from_the_settings_to_the_copy(
    tmp_path: Path, sockets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(Path(dappled.__file__).parents[1]), prepend=os.pathsep)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(sockets))

    def step(line: list[str], code: int = 0) -> str:
        done = command(*line, cwd=tmp_path)
        assert done.returncode == code, (line, done.stdout, done.stderr)
        assert "problem" not in done.stderr
        return done.stdout + done.stderr

    link = f"udpin:127.0.0.1:{free_port()}"
    step(["init", "--camera", "canon-eos-450d", "--mask", "mask-2", "--link", link])
    assert "dappled.toml: good" in step(steps("3.")["config check"])
    (made,) = re.findall(r"`python -m (dappled\.mocks\.shoot [^`]*)`", OPERATING)
    subprocess.run([sys.executable, "-m", *made.split()], cwd=tmp_path, check=True, timeout=120)
    calibrate = [word.replace(".cr2", ".dng") for word in steps("4.")["calibrate"]]
    assert "written to calibration.toml" in step(calibrate)
    with (tmp_path / "dappled.toml").open("a") as file:
        file.write('\n[decode]\ncalibration = "calibration.toml"\n')
    assert "dappled.toml: good" in step(steps("3.")["config check"])
    (run,) = re.findall(r"`(dappled run --simulate --config \S+)` is the service", OPERATING)
    with subprocess.Popen(
        [sys.executable, "-m", "dappled", *words(run)],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stderr is not None
            for line in process.stderr:
                assert "problem" not in line
                if line == "camera ready\n":
                    break
            found = step(steps("5.")["doctor"])
            assert "the daemon simulates" in found
            assert "GO, with the cautions above" in found
            with subprocess.Popen(
                [sys.executable, "-m", "dappled", *steps("6.")["watch"]],
                cwd=tmp_path,
                stdout=subprocess.PIPE,
                text=True,
            ) as watching:
                (trigger,) = re.findall(r"`(dappled trigger --config \S+)`", OPERATING)
                assert "image 0" in step([*words(trigger), "--count", "3"])
                seen, _ = watching.communicate(timeout=120)
            assert watching.returncode == 0, seen
            assert "all is well" in step(steps("6.")["status"])
            process.send_signal(signal.SIGINT)
            _out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 0, err
    assert err.endswith("3 shots: 3 frames safe, 3 decoded, 0 with a problem\n")
    after = steps("7.")
    (flight,) = (entry.name for entry in (tmp_path / "flights").iterdir() if entry.is_dir())
    assert f"{flight}  " in step(after["flight list"])
    assert "the counts agree" in step(after["flight report"])
    assert "consistent" in step(after["flight check"])
    assert "give a folder on another disk" in step(after["flight offload"], 1)
    assert "copied and verified" in step([*after["flight offload"], "--same-device"])
    said = step([word.replace("FLIGHT", flight) for word in after["geotag"]])
    no_geoid = r"(?:heights stay above mean sea level: no geoid grid is on this machine .*\n)?"
    made = re.fullmatch(r"3 frames placed, 6 files written to (\S+) and (\S+)\n" + no_geoid, said)
    assert made is not None, said
    assert [(tmp_path / name).is_dir() for name in made.groups()] == [True, True]
