"""`dappled init` proposes what is plugged in, asks for the rest, and writes a file that `config check` passes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from dappled.cli import init, main
from dappled.config import settings
from dappled.drivers.usb_bus import CANON, FUJIFILM, UsbBody

CANON_450D = UsbBody(1, 5, CANON, 0x3176, "PTP", "Canon EOS 450D")
S5200 = UsbBody(1, 6, FUJIFILM, 0x01C1, "mass storage", "")


def proposed(found: list[UsbBody], serial: list[str]) -> dict[str, str]:
    return {one.flag: one.proposed for one in init.questions(found, serial)}


def test_what_is_plugged_in_is_proposed() -> None:
    assert proposed([CANON_450D], ["/dev/ttyACM0,115200"])["--camera"] == "canon-eos-450d"
    assert proposed([S5200], [])["--camera"] == ""  # any body of that make may be one: a person says
    assert proposed([], [])["--camera"] == "auto"
    assert proposed([], ["/dev/ttyACM0,115200"])["--link"] == "/dev/ttyACM0,115200"
    assert proposed([], [])["--link"].startswith("udpin:")
    assert proposed([], [])["--folder"] == "~/flights"  # of who runs the daemon, which is not who runs this
    assert proposed([CANON_450D], [])["--mask"] == ""  # no body says which mask is in it


def test_serial_devices_come_with_a_speed(tmp_path: Path) -> None:
    for name in ("ttyUSB1", "ttyAMA0", "ttyACM0", "tty0"):
        (tmp_path / name).touch()
    assert init.serial_devices(tmp_path) == [
        f"{tmp_path}/ttyACM0,115200", f"{tmp_path}/ttyUSB1,57600", f"{tmp_path}/ttyAMA0,921600"
    ]  # fmt: skip


def test_an_empty_answer_takes_what_is_proposed_and_is_asked_again_without(capsys: pytest.CaptureFixture[str]) -> None:
    answers, right = iter(["", " ", "mask-2"]), str
    assert init.ask(init.Question("--camera", "which body", "auto"), lambda _: next(answers), right) == "auto"
    assert init.ask(init.Question("--mask", "which mask", "", ["mask-2"]), lambda _: next(answers), right) == "mask-2"
    assert "which body [auto]" in capsys.readouterr().err


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with nothing plugged in."""
    monkeypatch.setattr(init, "bodies", list)
    monkeypatch.setattr(init, "serial_devices", list)


FLAGS = ["--camera", "canon-eos-450d", "--mask", "mask-2", "--link", "/dev/ttyAMA0,921600"]


@pytest.mark.usefixtures("alone")
def test_the_file_is_written_and_passes_config_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "dappled.toml"
    words = ["init", str(file), *FLAGS, "--folder", str(tmp_path / "flights"), "--json"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["settings"]["mask"] == {"profile": "mask-2"}
    loaded = settings.load(file)
    assert (loaded.camera.profile, loaded.mask.profile) == ("canon-eos-450d", "mask-2")
    assert (loaded.mavlink.url, loaded.record.directory) == (("/dev/ttyAMA0,921600",), str(tmp_path / "flights"))
    assert main(["config", "check", str(file)]) == 0
    before = file.read_bytes()
    assert main(words) == 1  # it is not replaced unasked
    assert "--overwrite" in capsys.readouterr().err
    assert file.read_bytes() == before
    assert main([*words, "--overwrite"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["dappled.toml"]


def at_a_terminal(monkeypatch: pytest.MonkeyPatch, *answers: str) -> list[str]:
    """A person who gives these answers; returns those that are left."""
    left = list(answers)
    for stream in (sys.stdin, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _: left.pop(0))
    return left


@pytest.mark.usefixtures("alone")
def test_a_wrong_answer_is_asked_again_with_the_nearest_name_and_the_others_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "dappled.toml"
    cameras, masks = ("canon-eos-450", "fujifilm-s5200"), ("mask2", "mask-2")
    left = at_a_terminal(
        monkeypatch, *cameras, "gpio", "autopilot", *masks, "what:ever", "none", str(tmp_path / "flights")
    )
    assert main(["init", str(file)]) == 0
    assert left == []
    said = capsys.readouterr().err
    for nearest in ("did you mean canon-eos-450d?", "did you mean mask-2?"):
        assert nearest in said
    loaded = settings.load(file)
    assert (loaded.camera.profile, loaded.camera.shutter) == ("fujifilm-s5200", "autopilot")
    assert (loaded.mask.profile, loaded.mavlink.url) == ("mask-2", ())


@pytest.mark.usefixtures("alone")
def test_nothing_is_asked_for_a_file_that_can_t_be_written_or_beside_a_wrong_flag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    left = at_a_terminal(monkeypatch, "auto")
    assert main(["init", str(tmp_path / "missing" / "x.toml")]) == 2
    assert main(["init", str(tmp_path / "x.toml"), "--mask", "mask2"]) == 2
    assert left == ["auto"]
    said = capsys.readouterr().err
    assert "missing is no folder" in said
    assert "did you mean mask-2?" in said


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    ("flag", "value", "words"),
    [("--mask", "mask-9", "mask-9"), ("--camera", "canon-eos-9", "canon-eos-9"), ("--link", "what:ever", "what")],
)
def test_what_config_check_refuses_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flag: str, value: str, words: str
) -> None:
    file = tmp_path / "dappled.toml"
    call = ["init", str(file), *FLAGS, "--folder", str(tmp_path), flag, value]
    assert main(call) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "dappled.toml" in said
    assert ".part" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("alone")
def test_without_a_person_the_mask_must_be_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path / "x.toml"), "--json"]) == 1
    assert "give --mask" in capsys.readouterr().err


@pytest.mark.usefixtures("alone")
def test_without_a_name_it_is_the_file_that_the_documents_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "--mask", "mask-2", "--link", "none", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["file"] == "dappled.toml"
    assert settings.load(tmp_path / "dappled.toml").mask.profile == "mask-2"
    assert main(["init", "--mask", "mask-1", "--link", "none", "--json"]) != 0
    assert "--overwrite" in capsys.readouterr().err
    assert settings.load(tmp_path / "dappled.toml").mask.profile == "mask-2"


@pytest.mark.usefixtures("alone")
def test_a_body_that_usb_can_t_fire_gets_its_driver_and_needs_a_shutter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "x.toml"
    words = ["init", str(file), "--camera", "fujifilm-s5200", "--mask", "mask-2", "--link", "none"]
    assert main([*words, "--json"]) == 1
    assert "give --shutter" in capsys.readouterr().err
    assert main([*words, "--shutter", "autopilot", "--json"]) == 0
    loaded = settings.load(file)
    assert (loaded.camera.driver, loaded.camera.shutter) == ("fujifilm", "autopilot")
    assert main(["config", "check", str(file)]) == 0
