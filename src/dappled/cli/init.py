"""`dappled init`: write a settings file from what is plugged in and a few questions, and check it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, argument, of_setting, option, refuse_no_folder
from dappled.config import settings
from dappled.config.schema import TomlSource
from dappled.config.settings import CameraSettings, RecordSettings, SettingsFile
from dappled.errors import DappledError
from dappled.shown import say

if not words_only:
    import tomli_w

    from dappled.config import profiles
    from dappled.daemon import settings_check
    from dappled.drivers import usb_bus
    from dappled.drivers.usb_bus import UsbBody

ANY, NONE = "auto", "none"
FLIGHTS = RecordSettings().directory
WIRED = "fujifilm"  # bodies of this make are fired by a line, not over USB
_SERIAL = ("ttyACM*", "ttyUSB*", "ttyAMA0", "serial0", "ttyTHS1")
_BAUD = {"ttyACM": ",115200", "ttyUSB": ",57600"}  # USB of an autopilot; a telemetry radio
_WIRED_BAUD = ",921600"
_DEFAULT_LINK = "udpin:0.0.0.0:14550"
_NOT_YET = {"--camera": ANY, "--shutter": "outside", "--mask": NONE, "--link": NONE, "--folder": FLIGHTS}


@dataclass(frozen=True, slots=True)
class Question:
    """One setting that is asked for: its flag, its words, what is proposed, and what else there is to choose from."""

    flag: str
    words: str
    proposed: str
    choices: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class InitSettings(Overwriting, Verb):
    """Write a settings file."""

    examples = (
        "dappled init dappled.toml",
        "dappled init dappled.toml --camera canon-eos-450d --mask mask-2 --link /dev/ttyAMA0,921600 --folder ~/flights",
    )

    file: Path = argument("FILE", "settings file to write (default: dappled.toml)", default=Path("dappled.toml"))
    camera: str | None = option("--camera", of_setting(CameraSettings, "profile"), None)
    shutter: str | None = option("--shutter", of_setting(CameraSettings, "shutter"), None, metavar="LINE")
    mask: str | None = option("--mask", "mask profile or TOML file, or none", None)
    link: str | None = option(
        "--link", "the autopilot's link, such as /dev/ttyAMA0,921600, or none", None, metavar="URL",
    )  # fmt: skip
    folder: str | None = option("--folder", of_setting(RecordSettings, "directory"), None, metavar="DIR")

    def check(self) -> None:
        self.refuse_existing(self.file)
        refuse_no_folder(self.file)

    def run(self, output: Output) -> Report:
        asks = sys.stdin.isatty() and sys.stderr.isatty() and not self.json
        given = {"--camera": self.camera, "--shutter": self.shutter, "--mask": self.mask}
        given |= {"--link": self.link, "--folder": self.folder}
        refuse_wrong({flag: said for flag, said in given.items() if said}, self.file)  # before anything is asked
        found = bodies()
        if asks:
            output.remark(f"on the bus: {', '.join(_named(body) for body in found) or 'no camera'}")
        answers: dict[str, str] = {}
        for question in questions(found, serial_devices()):
            if question.flag == "--shutter" and not answers["--camera"].startswith(WIRED):
                continue
            answer = given[question.flag]
            if answer is None:
                answer = self._asked(question, answers) if asks else question.proposed
            if not answer:
                raise DappledError(f"nobody is there to ask: give {question.flag} ({question.words})")
            answers[question.flag] = answer
        refuse_wrong(answers, self.file)
        text = settings_text(answers)
        try:
            durable.write_file(self.file, text.encode())
        except OSError as error:
            raise DappledError(f"{self.file} can't be written: {error.strerror}") from error
        if not self.json:
            output.remark(f"{self.file}: good; next: dappled doctor --config {self.file}")
        return Report({"file": str(self.file), "settings": tables(answers)}, text.splitlines())

    def _asked(self, question: Question, answers: dict[str, str]) -> str:
        """The person's answer, which goes with those before it."""
        return ask(question, input, lambda said: refuse_wrong(answers | {question.flag: said}, self.file))


def questions(found: Sequence[UsbBody], serial: Sequence[str]) -> list[Question]:
    """What is asked, with what is proposed by what is plugged in; "" where nothing can be proposed."""
    cameras, masks = profiles.shipped("cameras"), profiles.shipped("masks")
    fits = [profile.name for body in found if (profile := profiles.camera_for_model(body.name)) is not None]
    strange = [body for body in found if not fits and not body.fires]  # a reader of cards or another camera: ask
    body = fits[0] if fits else "" if strange else ANY
    link = serial[0] if serial else _DEFAULT_LINK
    return [
        Question("--camera", "which camera body", body, [ANY, *cameras]),
        Question("--shutter", "how its shutter is fired: USB can't", "", ["outside", "autopilot"]),
        Question("--mask", "which mask is in it", "", [NONE, *masks]),
        Question("--link", "where the autopilot is", link, [*serial, _DEFAULT_LINK, NONE]),
        Question("--folder", "where flights are kept (~ is the home of the user who runs the daemon)", FLIGHTS),
    ]


def refuse_wrong(answers: dict[str, str], file: Path) -> None:
    """Refuse answers of which `config check` would refuse the settings file. Raises DappledError."""
    folder = file.absolute().parent
    if not os.access(folder, os.W_OK):
        raise DappledError(f"{file} can't be written: {folder} is no folder that you may write to")
    read = settings.of_tables(tables(_NOT_YET | answers), str(file))
    examined = SettingsFile(settings.resolve(read, folder), TomlSource(str(file)))
    settings_check.checked(examined, by_this_user=False)


def ask(question: Question, answer: Callable[[str], str], check: Callable[[str], object]) -> str:
    """The person's answer, or what was proposed for an empty one. Asks again where there is neither, and where `check`
    refuses it, with its sentences."""
    if question.choices:
        say(f"  {', '.join(question.choices)}", error=True)
    proposed = f" [{question.proposed}]" if question.proposed else ""
    while True:
        say(f"{question.words}{proposed}: ", error=True, end="")
        try:
            said = answer("").strip()
        except EOFError:
            if not question.proposed:
                raise DappledError(f"there was no answer: give {question.flag}") from None
            return question.proposed
        said = said or question.proposed
        try:
            if said:
                check(said)
                return said
        except DappledError as error:
            for sentence in error.sentences:
                say(f"  {sentence}", error=True)


def tables(answers: dict[str, str]) -> dict[str, dict[str, Any]]:
    """The settings file's tables. Only what differs from the built-in settings stands in it."""
    body, mask, link = answers["--camera"], answers["--mask"], answers["--link"]
    found: dict[str, dict[str, Any]] = {}
    if body != ANY:
        found["camera"] = {"profile": body}
    if body.startswith(WIRED):
        found["camera"] |= {"driver": "fujifilm", "shutter": answers["--shutter"]}
    if mask != NONE:
        found["mask"] = {"profile": mask}
    found["mavlink"] = {"url": [] if link == NONE else link}
    if answers["--folder"] != FLIGHTS:
        found["record"] = {"directory": answers["--folder"]}
    return found


def settings_text(answers: dict[str, str]) -> str:
    """The settings file."""
    return f"# Written by dappled init; all settings: dappled config show\n{tomli_w.dumps(tables(answers))}"


def bodies() -> list[UsbBody]:
    """The cameras on the bus; none where it can't be read."""
    try:
        return usb_bus.bodies()
    except DappledError:
        return []


def serial_devices(dev: Path = Path("/dev")) -> list[str]:
    """Serial devices at which an autopilot may be, with the usual speed of each."""
    found = [path.name for pattern in _SERIAL for path in sorted(dev.glob(pattern))]
    return [f"{dev / name}{_BAUD.get(name.rstrip('0123456789'), _WIRED_BAUD)}" for name in dict.fromkeys(found)]


def _named(body: UsbBody) -> str:
    return f"{body.maker} {body.name}".strip() + f" at {body.port}"
