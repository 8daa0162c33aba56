"""Find everything in settings that can't work, at once. `config check`, `run` and `doctor` refuse the same.

Nothing is opened but files that the settings name, and nothing is changed. Hardware that is not there is no finding: it
may come, and the daemon waits for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dappled.config import profiles
from dappled.config.schema import BadSetting, ConfigError, refuse
from dappled.config.settings import Settings, SettingsFile
from dappled.daemon.configured_links import key_files
from dappled.daemon.console import process as console_process
from dappled.daemon.stream import curve, sockets
from dappled.drivers.gnss.port import address as gnss_address
from dappled.drivers.mavlink import LinkError, parse, read_key
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.recipe import Recipe
from dappled.drivers.registry import open_camera
from dappled.errors import DappledError
from dappled.findings import told
from dappled.flight import layout, seal_key


@dataclass(frozen=True, slots=True)
class SettingsRule:
    """One thing that must be so. `place` is the setting to blame where the error tells of none; `reads` are further
    ones that `check` needs, as "table.key". `check` raises DappledError: what is wrong, a line for each thing.

    Who runs the daemon decides rules of `secrets`: files that only their owner can read. What `may_come` keeps no
    daemon from starting: a flight needs no map. Whether flights can be written is seen when one begins: a disk may
    come late.
    """

    place: str
    check: Callable[[Settings], object]
    reads: tuple[str, ...] = ()
    may_come: bool = False
    secrets: Callable[[Settings], tuple[str, ...]] = lambda _: ()

    def depends_on_user(self, settings: Settings) -> bool:
        """Whether this user can't tell."""
        return any(_of_another(Path(name)) for name in self.secrets(settings) if name)


def _of_another(file: Path) -> bool:
    try:
        return file.stat().st_uid != os.getuid()
    except PermissionError:
        return True
    except OSError:
        return False


def findings(file: SettingsFile, *, by_this_user: bool = True, starting: bool = False) -> list[BadSetting]:
    """What is wrong in a settings file: what can't be read, and what can't work. A rule that reads a setting which is
    wrong already is left out; where another user may run the daemon, a rule that depends on the user; and for a daemon
    that is `starting`, one whose subject may come."""
    found = list(file.findings)
    said: set[str] = set()  # a rule may need what another one checks
    wrong = {f"{finding.table}.{finding.key}" if finding.key else finding.table for finding in found}
    for rule in RULES:
        read = {rule.place, *rule.reads}
        if starting and rule.may_come:
            continue
        if not by_this_user and rule.depends_on_user(file.settings):
            continue
        if read & wrong or {name.partition(".")[0] for name in read} & wrong:
            continue
        try:
            rule.check(file.settings)
        except DappledError as error:
            new = [text for text in error.sentences if text not in said]
            said.update(new)
            found += [_finding(file, rule.place, error.setting, text) for text in new]
    return found


def checked(file: SettingsFile, *, by_this_user: bool = True, starting: bool = False) -> Settings:
    """The settings of a file. Raises ConfigError with everything that is wrong, see `findings`."""
    refuse(findings(file, by_this_user=by_this_user, starting=starting))
    return file.settings


def _finding(file: SettingsFile, place: str, setting: str, text: str) -> BadSetting:
    """A finding at the setting that an error tells of, if the file has it; else at `place`."""
    table, _, key = setting.partition(".")
    if not file.source.has(table, key):
        table, _, key = place.partition(".")
    return BadSetting(table, key, f"{file.source.where(table, key)}: {text}")


def _links(settings: Settings) -> None:
    wrong = []
    for url in dict.fromkeys(settings.mavlink.url):
        try:
            parse(url)
        except LinkError as error:
            wrong.append(str(error))
        if settings.mavlink.url.count(url) > 1:
            wrong.append(f"mavlink.url names {url!r} twice; remove one")
    if wrong:
        raise ConfigError(*wrong)


def _feedback(settings: Settings) -> None:
    if settings.mavlink.feedback_is_shot and not settings.camera.fired_outside:
        raise ConfigError(
            "mavlink.feedback_is_shot is for a camera that the autopilot fires, and dappled would fire it once more: "
            'set camera.shutter = "outside"'
        )


def _gnss(settings: Settings) -> None:
    if not settings.gnss.port:
        return
    at = gnss_address(settings.gnss.port)
    if any(link.kind == "serial" and link.host == at.host for link in map(parse, settings.mavlink.url)):
        raise ConfigError(
            f"gnss.port {settings.gnss.port!r} is also a link of mavlink.url: each needs a port of its own"
        )


def _trigger(settings: Settings) -> None:
    trigger = settings.trigger
    if trigger.distance_m and trigger.overlap:
        raise ConfigError(
            "trigger.distance_m and trigger.overlap both say how far photographs are apart: keep one",
            setting="trigger.distance_m",
        )
    if trigger.from_height_m and not (trigger.distance_m or trigger.overlap):
        raise ConfigError("trigger.from_height_m begins photographs by distance or overlap: set one of those")
    if trigger.from_height_m and settings.camera.fired_outside:
        raise ConfigError("trigger.from_height_m is for a camera that dappled fires, and something else fires this one")


def _link_keys(settings: Settings) -> None:
    for key in filter(None, key_files(settings)):
        read_key(key)


def _directory(settings: Settings) -> None:
    place = layout.existing(Path(settings.record.directory))
    if not place.is_dir():
        raise ConfigError(f"{place} is not a folder: move it away, or set record.directory")


def _seal(settings: Settings) -> None:
    if settings.record.seal_key:
        seal_key.load(Path(settings.record.seal_key))


def _camera_profile(settings: Settings) -> None:
    if settings.camera.profile != "auto":
        profiles.camera(settings.camera.profile)


def _mask_profile(settings: Settings) -> None:
    if settings.mask.profile not in ("", profiles.LENSLET):
        profiles.mask(settings.mask.profile)


def _calibration(settings: Settings) -> None:
    decode = settings.decode
    if not settings.mask.profile:  # it is read only with a mask
        return
    wrong = calibration_files.misfit(
        Recipe(
            camera=settings.camera.profile,
            mask=settings.mask.profile,
            law=decode.law,
            calibration=decode.calibration,
        )
    )
    if wrong is not None:
        raise ConfigError(str(told(wrong)))


def _frame(settings: Settings, name: str) -> None:
    if name and settings.mask.profile:
        from dappled.drivers.raw import reading  # noqa: PLC0415  # see `after_ready`

        reading.read_metadata(Path(name))


def _stream(settings: Settings) -> None:
    sockets.check_endpoint(settings.publish.slices, keyed=bool(settings.publish.keys))


def _ask(settings: Settings) -> None:
    if settings.publish.ask:
        sockets.check_endpoint(settings.publish.ask, keyed=bool(settings.publish.keys))


def _console(settings: Settings) -> None:
    if settings.console.bind:
        console_process.credentials(settings.console)


def _map(settings: Settings) -> None:
    if settings.console.map:
        from dappled.daemon.console import placement  # noqa: PLC0415  # a daemon that starts does not ask for it

        placement.load_background(Path(settings.console.map))


def _area(settings: Settings) -> None:
    if settings.console.area:
        from dappled.decode.geometry import area  # noqa: PLC0415  # as above

        area.read(Path(settings.console.area))


RULES: tuple[SettingsRule, ...] = (
    SettingsRule(
        "camera.driver",
        lambda settings: open_camera(settings.camera),
        tuple(f"camera.{key}" for key in ("shutter", "pickup", "port", "serial", "options", "file_timeout_s")),
    ),
    SettingsRule("camera.profile", _camera_profile),
    SettingsRule("mask.profile", _mask_profile),
    SettingsRule("mavlink.url", _links),
    SettingsRule("mavlink.feedback_is_shot", _feedback, ("camera.shutter", "camera.driver")),
    SettingsRule("trigger.from_height_m", _trigger, ("trigger.distance_m", "trigger.overlap", "camera.shutter")),
    SettingsRule("gnss.port", _gnss, ("mavlink.url",)),
    SettingsRule("mavlink.keys", _link_keys, ("mavlink.url",), secrets=lambda settings: settings.mavlink.keys),
    SettingsRule("record.directory", _directory),
    SettingsRule("record.seal_key", _seal, secrets=lambda settings: (settings.record.seal_key,)),
    SettingsRule("decode.calibration", _calibration, ("camera.profile", "mask.profile", "decode.law")),
    SettingsRule("decode.white", lambda settings: _frame(settings, settings.decode.white), ("mask.profile",)),
    SettingsRule("decode.dark", lambda settings: _frame(settings, settings.decode.dark), ("mask.profile",)),
    SettingsRule("publish.slices", _stream, ("publish.keys",)),
    SettingsRule("publish.ask", _ask, ("publish.keys",)),
    SettingsRule(
        "publish.keys",
        lambda settings: curve.server(settings.publish.keys, settings.publish.clients),
        secrets=lambda settings: (settings.publish.keys,),
    ),
    SettingsRule("console.bind", _console, ("console.token",), secrets=lambda settings: (settings.console.token,)),
    SettingsRule("console.map", _map, may_come=True),
    SettingsRule("console.area", _area, may_come=True),
)
