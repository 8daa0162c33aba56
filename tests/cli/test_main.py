"""The command line as a whole: help everywhere, one sentence for a failure, the exit codes of the contract."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import warnings
from pathlib import Path
from typing import get_args

import pytest

import dappled.cli
from dappled.cli import VERBS, main
from dappled.cli.command_line import options, verb_class
from dappled.cli.mask.arguments import FILM_NAMES
from dappled.cli.table import GROUPS
from dappled.cli.verb import Report
from dappled.config.settings import LAW_NAMES
from dappled.decode.depth import estimate
from dappled.decode.optics import LAWS
from dappled.decode.optics.film import FILMS
from dappled.decode.optics.laser_bench import THESIS_DISTANCE_M, THESIS_WAVELENGTH_NM
from dappled.decode.optics.lenses import SHIFT_SIGMA_PX
from dappled.decode.spectrum.pictures import Look
from dappled.products.exports.exports import ESLF_LENSLET_PX
from dappled.products.maps.refly import SLOWEST_M_S


@pytest.mark.parametrize("path", [*VERBS, *GROUPS])
def test_every_verb_has_help_with_an_example_of_itself(path: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*path.split(), "--help"])
    assert ended.value.code == 0
    assert f"dappled {path}" in capsys.readouterr().out.partition("example")[2]


HELPS = """
import contextlib, io, json, sys
from dappled.cli import main
from dappled.cli.table import GROUPS, VERBS
said = {}
for path in ["calibrate lens --mask m", *VERBS, *GROUPS]:
    sys.argv = ["dappled", *path.split(), "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main()
    said[path] = out.getvalue()
print(json.dumps([said, list(sys.modules)]))
"""
WORK = {"numpy", "scipy", "PIL", "zmq", "pymavlink", "rawpy", "pyproj", "tifffile", "usb", "gphoto2", "tomli_w"}


def test_help_loads_nothing_of_what_the_work_needs() -> None:
    done = subprocess.run([sys.executable, "-c", HELPS], capture_output=True, text=True, timeout=60, check=True)
    said, loaded = json.loads(done.stdout)
    for path in [*VERBS, *GROUPS]:
        assert f"dappled {path}" in said[path].partition("example")[2], path
    assert said["calibrate lens --mask m"] == said["calibrate"]
    assert not WORK & set(loaded)
    ours = {".".join(name.split(".")[1:3]) for name in loaded if name.startswith("dappled.daemon.")}
    assert ours <= {"daemon.health"}


def test_what_help_names_by_itself_is_what_the_work_knows() -> None:
    words = {path: verb_class(path).__dataclass_fields__ for path in VERBS}
    assert tuple(LAWS) == LAW_NAMES
    assert tuple(FILMS) == FILM_NAMES
    assert words["carriers"]["look"].metadata["argument"].rule.choices == get_args(Look)
    assert words["depth"]["method"].metadata["argument"].rule.text == ", ".join(estimate.METHODS)
    assert f"LFToolbox: {ESLF_LENSLET_PX})" in words["export"]["lenslet"].metadata["argument"].rule.text
    assert words["mask design"]["shift_error"].default == SHIFT_SIGMA_PX
    assert words["flight coverage"]["slowest"].default == SLOWEST_M_S
    bench = words["mask diffraction"]
    assert (bench["wavelength"].default, bench["distance"].default) == (THESIS_WAVELENGTH_NM, THESIS_DISTANCE_M)


_HIGH = ["--camera", "reference-36mm", "--focal-length", "50", "--altitude", "50"]


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["fly"],
        ["run", "--frames", "many"],
        ["carriers"],
        ["trigger", "--what"],
        ["trigger", "--count", "0"],
        ["mask", "make", "--period", "nan", "-o", "x.png"],
        ["watch", "fish://"],
        ["watch", "--ask", "fish://"],
        ["status", "tcp://nowhere"],
        ["mask", "plan", *_HIGH, "--speed", "0"],
        ["mask", "plan", *_HIGH, "--speed", "5", "--overlap", "80"],
        ["mask", "plan", *_HIGH, "--speed", "5", "--exposure", "inf"],
        ["mask", "plan", *_HIGH, "--speed", "5", "--altitude", "-5"],
        ["mask", "diffraction", "--mask", "mask-1", "--wavelength", "0.000532"],
    ],
)
def test_a_wrong_call_ends_with_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["config", "check", "nowhere.toml"], 2, "nowhere.toml: no such file"),
        (["mask", "design", *_HIGH, "--views", "4"], 2, "views = 4 must be odd"),
        (["trigger", "--url", "nonsense"], 2, "not a connection string"),
        (["flight", "show", "nowhere"], 2, "nowhere: no such file or folder"),
        (["flight", "show", "."], 2, "is not a flight folder"),
        (["flight", "list", "there.dng"], 2, "is no folder"),
        (["flight", "check", ".", "--key", "."], 2, "is not a flight folder"),
        (["batch", ".", "-o", "out", "--as", "npz"], 2, "is not a flight folder"),
        (["geotag", "."], 2, "is not a flight folder"),
        (["georeference", "there.dng"], 2, "is not a flight folder (it is a file)"),
        (["export", ".", "--as", "npz", "-o", "x.npz"], 2, "holds 0 pictures"),
        (["views", "there.dng", "-o", "x.png"], 2, "is not a light field"),
        (["decode", "empty", "--mask", "mask-2", "-o", "x.npz"], 2, "holds no frame"),
        (["carriers", ".", "--mask", "mask-2"], 2, "is a folder"),
        (["init", "none/dir/x.toml", "--mask", "none"], 2, "is no folder; make it first"),
        (["keys", "make", "a/b"], 2, "can't be the name of a key"),
        (["keys", "show", "."], 2, "is a folder"),
        (["keys", "token", "none/token"], 2, "is no folder; make it first"),
        (["keys", "seal", "none/key"], 2, "is no folder; make it first"),
        (["mavlink", "key", "none/key"], 2, "is no folder; make it first"),
        (["keys", "show", "there.dng"], 2, "holds no public key"),
        (["open", "--no-browser", "notes.txt"], 2, "is no frame"),
        (["open", "--no-browser", "empty"], 2, "holds 0 pictures"),
        (["replay", "there.dng"], 2, "neither a flight nor a folder of frames"),
        (["replay", "empty"], 2, "no frame in empty"),
        (["replay", "empty", "--telemetry", "empty"], 2, "is a folder; name a file"),
        (["decode", "nowhere.dng", "--mask", "mask-2", "-o", "x.npz"], 2, "nowhere.dng"),
        (["decode", "there.dng", "--mask", "mask-22", "-o", "x.npz"], 2, "did you mean mask-2"),
        (["decode", "there.dng", "--black", "300", "--white-level", "255", "-o", "x.npz"], 2, "is not below"),
        (["carriers", "--mask", "mask-2", "--shape", "10", "10"], 2, "--camera"),
        (["carriers", "--mask", "mask-2", "--shape", "10", "10", "--camera", "fujifilm-s5200"], 2, "--focal-length"),
    ],
)
def test_a_failure_is_one_sentence_and_has_its_exit_code(
    *,
    words: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.dng").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "empty").mkdir()
    assert main(words) == code
    err = capsys.readouterr().err
    assert said in err
    *usage, sentence = err.splitlines()
    assert sentence.startswith(f"dappled {words[0]}")
    assert all(line.startswith(f"usage: dappled {words[0]}") for line in usage)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["georeference", "f", "--ground", "high"], "--ground: 'high' is not a number in m"),
        (["georeference", "f", "--gsd", "0"], "--gsd: '0' is not a number above 0 m"),
        (["replay", "f", "--interval", "-1"], "--interval: '-1' is not a number from 0 to 86400 s"),
    ],
)
def test_a_refused_number_tells_its_unit(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_an_unforeseen_error_has_no_traceback_without_debug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("of its own kind")

    monkeypatch.setattr("dappled.cli.config.ListProfiles.run", broken)
    assert main(["profiles"]) == 1
    assert "unexpected RuntimeError: of its own kind" in capsys.readouterr().err
    with pytest.raises(RuntimeError):
        main(["--debug", "profiles"])


def test_a_library_s_warning_is_for_the_log_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    def warned(*_: object) -> Report:
        warnings.warn("divide by zero encountered in log", RuntimeWarning, stacklevel=1)
        return Report()

    monkeypatch.setattr("dappled.cli.config.ListProfiles.run", warned)
    for words, logged in ((["profiles"], False), (["--debug", "profiles"], True)):
        caplog.clear()
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            logging.captureWarnings(False)  # as before the first command of a process
            assert main(words) == 0
        assert capsys.readouterr().err == ""
        assert ("divide by zero" in caplog.text) is logged


def test_every_verb_prints_json() -> None:
    assert len(VERBS) > 35
    assert [path for path in VERBS if "--json" not in options(path)] == []


def test_profiles_and_settings_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["profiles", "--json"]) == 0
    profiles = json.loads(capsys.readouterr().out)
    assert {"name": "mask-2-full", "carriers": 25}.items() <= next(
        m for m in profiles["masks"] if m["name"] == "mask-2-full"
    ).items()
    assert main(["config", "show", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["camera"]["driver"] == "gphoto2"
    assert main(["config", "show"]) == 0
    assert "[mavlink]" in capsys.readouterr().out


def test_config_check_says_good_or_why_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = tmp_path / "good.toml"
    good.write_text('[camera]\nprofile = "canon-eos-450d"\n[mask]\nprofile = "lenslet"\n')
    assert main(["config", "check", str(good)]) == 0
    assert "good" in capsys.readouterr().out
    bad = tmp_path / "bad.toml"
    bad.write_text('[camera]\nprofile = "canon"\n')
    assert main(["config", "check", str(bad)]) == 2
    assert "canon-eos-450d" in capsys.readouterr().err


def test_predicted_carriers_are_the_thesis_table_14_s_neighbours(capsys: pytest.CaptureFixture[str]) -> None:
    """Table 11 at 13 mm: 566 and 1132 bins across, 572 and 1144 down."""
    words = ["carriers", "--shape", "2776", "3688", "--camera", "fujifilm-s5200", "--mask", "mask-2"]
    assert main([*words, "--focal-length", "13", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    at = {(c["ky"], c["kx"]): (c["row"] - 1388, c["col"] - 1844) for c in found["carriers"]}
    assert at[1, 1] == pytest.approx((572, 566), abs=1)
    assert at[2, 2] == pytest.approx((1144, 1132), abs=1)
    assert set(at) == {(0, 0), *((a * k, b * k) for k in (1, 2) for a in (-1, 1) for b in (-1, 1))}


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert dappled.__version__ in capsys.readouterr().out
