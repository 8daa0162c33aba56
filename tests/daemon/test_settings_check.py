"""One validation for `config check`, `run` and `doctor`: everything that can't work, at once, with its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.cli import main
from dappled.config import profiles, settings
from dappled.daemon import settings_check
from dappled.decode.calibration import Calibration, LatticeFit
from dappled.decode.optics import LAWS
from dappled.drivers.raw import calibration_files

CAMERA, MASK = "canon-eos-450d", "mask-2"


def told(folder: Path, text: str) -> list[str]:
    """What is wrong with these settings."""
    file = folder / "d.toml"
    file.write_text(text)
    return [finding.text.removeprefix(f"{folder}/") for finding in settings_check.findings(settings.examine_file(file))]


def calibration(path: Path, camera: str = CAMERA, mask: str = MASK, law: str = "fd") -> Path:
    """A calibration for the first frame size of a camera."""
    body, printed = profiles.camera(camera), profiles.mask(mask).mask
    sensor = body.raw[0].sensor
    lattice = LAWS[law](printed, sensor, body.mask_distance_mm, 50.0)
    transfer = tuple(1.0 for _ in printed.half_orders())
    fit = LatticeFit(50.0, 16.0, lattice, 0.0, body.mask_distance_mm, True, (0.0, 0.0), transfer, 0.1, 0.1, 9)
    return calibration_files.save(path, Calibration(sensor.shape, law, printed, sensor, (fit,)))[0]


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ('[camera]\ndriver = "gphot2"', "line 2: [camera] driver", "there is no camera driver named 'gphot2'"),
        ('[camera]\ndriver = "fujifilm"\nshutter = "gpio:x"', "line 3: [camera] shutter", "is not a shutter line"),
        ('[camera]\ndriver = "fujifilm"\nshutter = "gpio:/dev/gpiochip0:-1"', "line 3", "is not a shutter line"),
        ('[camera]\ndriver = "folder"\npickup = "/no/such"', "line 3: [camera] pickup", "is not a folder"),
        (  # a value that reads like a setting blames none
            '[camera]\ndriver = "camera.port"\nport = "usb:"',
            "line 2: [camera] driver",
            "there is no camera driver named",
        ),
        (
            '[publish]\nslices = "tcp://0.0.0.0:5555"\nkeys = ""',
            "line 2: [publish] slices",
            "open to the network without keys",
        ),
        ('[camera]\nprofile = "canon"', "line 2: [camera] profile", "did you mean"),
        ('[mask]\nprofile = "mask-22"', "line 2: [mask] profile", "did you mean mask-2?"),
        ("[mavlink]\nfeedback_is_shot = true", "line 2: [mavlink] feedback_is_shot", "would fire it once more"),
        ('[gnss]\nport = "ttyACM0"', "line 2: [gnss] port", "needs a device"),
        ('[gnss]\nport = "/dev/ttyACM0,9601"', "line 2: [gnss] port", "can't run at 9601 baud"),
        (
            '[gnss]\nport = "/dev/ttyACM0"\n[mavlink]\nurl = "/dev/ttyACM0,57600"',
            "line 2: [gnss] port",
            "also a link of mavlink.url",
        ),
        ("[trigger]\ndistance_m = 5\noverlap = 0.5", "line 2: [trigger] distance_m", "keep one"),
        ("[trigger]\nfrom_height_m = 10", "line 2: [trigger] from_height_m", "set one of those"),
        ('[mavlink]\nurl = "udpin:nonsense"', "line 2: [mavlink] url", "needs a host and a port"),
        ('[mavlink]\nurl = "/dev/ttyAMA0,921601"', "line 2: [mavlink] url", "can't run at 921601 baud"),
        ('[mavlink]\nurl = ["udpin:0.0.0.0:1", "udpin:0.0.0.0:1"]', "line 2: [mavlink] url", "twice; remove one"),
        (
            '[mavlink]\nurl = "udpin:0.0.0.0:1"\nkeys = "no.key"',
            "line 3: [mavlink] keys",
            "can't be read as a signing key",
        ),
        ('[mavlink]\nurl = "udpin:0.0.0.0:1"\nkeys = ["a", "b"]', "line 3: [mavlink] keys", "2 files for 1 links"),
        ('[record]\ndirectory = "d.toml/flights"', "line 2: [record] directory", "is not a folder"),
        ('[record]\nseal_key = "no.key"', "line 2: [record] seal_key", "dappled keys seal makes one"),
        (
            '[mask]\nprofile = "mask-2"\n[decode]\ncalibration = "no.toml"',
            "line 4: [decode] calibration",
            "no such file",
        ),
        ('[mask]\nprofile = "mask-2"\n[decode]\nwhite = "no.dng"', "line 4: [decode] white", "no.dng"),
        ('[publish]\nslices = "udp://x"', "line 2: [publish] slices", "neither ipc:// nor tcp://"),
        ('[publish]\nslices = "tcp://127.0.0.1:99999"', "line 2: [publish] slices", "must be tcp://HOST:PORT"),
        ('[publish]\nslices = "tcp://0.0.0.0:5555"', "line 2: [publish] slices", "open to the network without keys"),
        ('[publish]\nkeys = "no.key"', "line 2: [publish] keys", "go together"),
        ('[publish]\nclients = "none"', "line 2: [publish] clients", "go together"),
        ('[console]\nbind = "nonsense"', "line 2: [console] bind", "must be host:port"),
        ('[console]\nbind = "0.0.0.0:1"', "line 2: [console] bind", "without a token"),
        ('[console]\nbind = "127.0.0.1:1"\ntoken = "no"', "line 2: [console] bind", "can't be read"),
        ('[console]\nmap = "no.png"', "line 2: [console] map", "has no world file"),
    ],
)
def test_what_can_not_work_is_named_with_its_place(tmp_path: Path, text: str, place: str, words: str) -> None:
    (sentence,) = told(tmp_path, text)
    assert sentence.startswith(f"d.toml, {place}")
    assert words in sentence


def test_everything_is_told_at_once(tmp_path: Path) -> None:
    text = (
        '[camera]\ndriver = "gphot2"\nmax_pending = 0\n[mask]\nprofile = "mask-22"\n[mavlink]\nurl = ["a", "b"]\n'
        '[decode]\ncalibration = "no.toml"\n[console]\nbind = "x"\ntokn = "y"\n[recrd]\n'
    )
    assert [sentence.partition(":")[0] for sentence in told(tmp_path, text)] == [
        *("d.toml, line 3", "d.toml, line 12", "d.toml, line 13"),  # what can't be read, then what can't work
        *("d.toml, line 2", "d.toml, line 5", "d.toml, line 7", "d.toml, line 7", "d.toml, line 9", "d.toml, line 11"),
    ]


@pytest.mark.parametrize("verb", [["config", "check"], ["run", "--config"], ["doctor", "--config"]])
def test_every_verb_refuses_the_same_with_exit_2(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], verb: list[str]
) -> None:
    text = f'[record]\ndirectory = "{tmp_path}/flights"\n[console]\nbind = "x"\n[mavlink]\nurl = "a"\n'
    sentences = told(tmp_path, text)
    assert main([*verb, str(tmp_path / "d.toml")]) == 2
    begins = f"dappled {' '.join(word for word in verb if not word.startswith('-'))}: "
    said = [line.removeprefix(begins).removeprefix(f"{tmp_path}/") for line in capfd.readouterr().err.splitlines()]
    assert said == sentences
    assert not (tmp_path / "flights").exists()


def test_hardware_that_is_not_there_is_waited_for(tmp_path: Path) -> None:
    text = (
        '[camera]\nport = "usb:009,009"\n[mavlink]\nurl = ["/dev/ttyNowhere,57600", "tcp:drone.invalid:5760", '
        '"udpin:203.0.113.7:14550"]\n'
    )
    assert told(tmp_path, text) == []
    text = '[camera]\ndriver = "fujifilm"\nshutter = "gpio:/dev/gpiochip97:3"\npickup = "storage"\n'
    assert told(tmp_path, text) == []


def test_a_calibration_must_be_for_mask_law_and_camera(tmp_path: Path) -> None:
    calibration(tmp_path / "c.toml")
    begin = f'[camera]\nprofile = "{CAMERA}"\n[decode]\ncalibration = "c.toml"\n'
    assert told(tmp_path, f'{begin}[mask]\nprofile = "{MASK}"\n') == []
    assert told(tmp_path, begin) == []  # without a mask nothing is decoded
    place = f"d.toml, line 4: [decode] calibration: {tmp_path}/c.toml "
    assert told(tmp_path, f'{begin}[mask]\nprofile = "mask-1"\n') == [
        f"{place}was made with another mask than mask-1: calibrate again, or choose its mask"
    ]
    assert told(tmp_path, f'{begin}law = "geometric"\n[mask]\nprofile = "{MASK}"\n') == [
        f"{place}was made by the law fd, not geometric: calibrate again, or choose its law"
    ]
    (sentence,) = told(
        tmp_path,
        f'[camera]\nprofile = "fujifilm-s5200"\n[decode]\ncalibration = "c.toml"\n[mask]\nprofile = "{MASK}"\n',
    )
    assert "px, which fujifilm-s5200 doesn't make: calibrate with that camera" in sentence


def test_a_daemon_starts_without_a_map_and_reads_no_white_frame_without_a_mask(tmp_path: Path) -> None:
    file = tmp_path / "d.toml"
    file.write_text('[console]\nmap = "no.png"\n[decode]\nwhite = "no.dng"\ncalibration = "no.toml"\n')
    read = settings.examine_file(file)
    (finding,) = settings_check.findings(read)
    assert finding.key == "map"
    assert settings_check.checked(read, starting=True) == read.settings


def test_a_folder_that_can_not_be_written_to_may_be_a_disk_that_comes_late(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """systemd starts the daemon again after exit code 1, and not after 2."""
    file = tmp_path / "d.toml"
    file.write_text('[record]\ndirectory = "/proc/flights"\n')
    assert main(["config", "check", str(file)]) == 0
    assert main(["run", "--config", str(file)]) == 1
    assert "/proc/flights" in capfd.readouterr().err


def test_secrets_of_the_service_are_judged_as_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "token").write_text("short")
    file = tmp_path / "d.toml"
    file.write_text('[console]\nbind = "127.0.0.1:1"\ntoken = "token"\n[record]\nseal_key = "none"\n')
    read = settings.examine_file(file)
    assert len(settings_check.findings(read)) == len(settings_check.findings(read, by_this_user=False)) == 2
    monkeypatch.setattr("dappled.daemon.settings_check.os.getuid", lambda: 4711)  # the token is another user's now
    (finding,) = settings_check.findings(read, by_this_user=False)
    assert finding.key == "seal_key"  # a file that isn't there is nobody's
