"""The one file a person writes. Every default flies: an empty file and a camera on the bus are a working daemon."""

from __future__ import annotations

import dataclasses
import difflib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled.config.schema import ConfigError, Rule, Source, build, read_toml, setting

DEPTH_METHODS = ("gradient", "contrast", "combined")  # fast to good
SOCKET_MODES = ("0600", "0660", "0666")


@dataclass(frozen=True, slots=True)
class CameraSettings:
    driver: str = setting(
        "gphoto2", "Driver by name: gphoto2, fujifilm, folder, simulated, or one that another package registers"
    )
    profile: str = setting("auto", "Camera profile by name or TOML file; auto goes by the model in the frame")
    serial: str = setting("", "Only the body with this serial number; empty takes the first found")
    port: str = setting("", "libgphoto2 port, such as usb: or ptpip:127.0.0.1:15740:15740; empty takes the first found")
    capture_target: str = setting("card", "Where the body keeps the file before it is fetched", choices=("card", "ram"))
    delete_after_download: bool = setting(False, "Delete from the card what is safe on disk; the card is a second copy")
    shutter: str = setting(
        "",
        "Shutter line of fujifilm and folder: gpio:CHIP:LINE, servo:OUTPUT:PRESSED:RELEASED, relay:NUMBER, autopilot",
    )
    pickup: str = setting("", "Where fujifilm and folder find files: later, storage, a libgphoto2 port, or a folder")
    options: dict | None = setting(None, "What the driver alone knows")  # type: ignore[type-arg]  # noqa: RUF009  the field's default is None; the driver checks what is in it
    latency_ms: float = setting(60.0, "From the trigger call to the start of the exposure", unit="ms", low=0, high=5000)
    latency_sigma_ms: float = setting(30.0, "How well that is known, 1 σ", unit="ms", low=0, high=5000)
    max_pending: int = setting(2, "Shots under way at once; a wish above that is refused", low=1, high=1000)
    file_timeout_s: float = setting(30.0, "A shot without a file for this long has failed", unit="s", low=1, high=3600)


@dataclass(frozen=True, slots=True)
class MaskSettings:
    profile: str = setting("", "Mask profile by name or TOML file, or lenslet; empty: frames are kept, not decoded")


@dataclass(frozen=True, slots=True)
class MavlinkSettings:
    url: tuple[str, ...] = setting((), "pymavlink connection strings, one or a list; empty: no link, no poses")
    component_id: int = setting(
        100, "MAV_COMP_ID_CAMERA and the five after it are what autopilots look for", low=1, high=255
    )
    system_id: int = setting(1, "Used until an autopilot is heard, whose id is then adopted", low=1, high=255)
    keys: tuple[str, ...] = setting(
        (), 'Signing key files (dappled mavlink key), one a link in the order of url, "" for none; one alone is for all'
    )
    unsigned: str = setting(
        "refuse",
        "Packets without a signature on a link with a key: refused, heard but not obeyed, or allowed",
        choices=("refuse", "listen", "allow"),
    )
    feedback_is_shot: bool = setting(
        False, "The autopilot fires the camera by wire, and each CAMERA_FEEDBACK of it is a shot"
    )


@dataclass(frozen=True, slots=True)
class RecordSettings:
    directory: str = setting("~/flights", "Folder that holds one folder a flight")
    utc: str = setting(
        "auto",
        "Who knows UTC: the system; the autopilot (learnt in flight, folders named by boot); auto judges the system",
        choices=("auto", "system", "autopilot"),
    )
    warn_free_mb: int = setting(2000, "Below this free space a warning is given", unit="MB", low=0, high=10_000_000)
    min_free_mb: int = setting(500, "Below this free space new shots are refused", unit="MB", low=0, high=10_000_000)


@dataclass(frozen=True, slots=True)
class PoseSettings:
    wait_ms: float = setting(
        700.0, "How long a tag may wait for telemetry after the exposure", unit="ms", low=0, high=10_000
    )
    attitude_sigma_deg: float = setting(
        0.0,
        "How well the autopilot knows its attitude, 1 σ, where it doesn't say; 0: not known",
        unit="°",
        low=0,
        high=90,
    )
    lever_arm_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "From the antenna to the camera: forward, right, down", unit="m", low=-100, high=100
    )
    mount: tuple[float, float, float, float, float, float, float, float, float] = setting(
        (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "Rotation from camera axes (right, down, forward) to body axes, row by row; default: down, image top forward",
        low=-1,
        high=1,
    )
    on_gimbal: bool = setting(
        False, "The camera hangs on the gimbal: its reported attitude counts, and mount turns camera axes into its axes"
    )


@dataclass(frozen=True, slots=True)
class DecodeSettings:
    enabled: bool = setting(True, "Decode in flight; frames can always be decoded later")
    law: str = setting("", "Carrier law; empty takes the camera profile's", choices=("", "fd", "geometric"))
    calibration: str = setting("", "File written by dappled calibrate; empty predicts from the profiles alone")
    white: str = setting("", "White frame; empty: none")
    dark: str = setting("", "Dark frame; empty: none")
    workers: int = setting(1, "Threads of one decode; 1 leaves the other core to capture", low=1, high=64)
    depth: str = setting("", "Depth in flight by this method; empty: none", choices=("", *DEPTH_METHODS))
    depth_to_autopilot: bool = setting(
        False, "Send the nearest distance as DISTANCE_SENSOR, where the calibration has targets' distances"
    )
    depth_interval_s: float = setting(5.0, "At most one frame's depth in this time", unit="s", low=0, high=3600)
    queue: int = setting(4, "Frames that may wait; more stay in the record, to be decoded later", low=1, high=1000)


@dataclass(frozen=True, slots=True)
class PublishSettings:
    slices: str = setting("", "ZeroMQ endpoint of the stream; empty: ipc in the user's runtime folder")
    ask: str = setting("", "ZeroMQ endpoint that answers questions about recorded frames; empty: beside the stream")
    high_water_mark: int = setting(
        3, "Messages, so stacks of slices, that may wait for one slow subscriber", low=1, high=1000
    )
    preview_interval_s: float = setting(1.0, "At most one preview in this time", unit="s", low=0, high=3600)
    socket_mode: str = setting("0660", "Who may connect to ipc sockets, as chmod says it", choices=SOCKET_MODES)
    keys: str = setting("", "Secret CURVE key for tcp endpoints, made by dappled keys make; empty: none off loopback")
    clients: str = setting("", "Folder with the public key, NAME.key, of each who may subscribe over tcp")


@dataclass(frozen=True, slots=True)
class ConsoleSettings:
    bind: str = setting("", "host:port of the operator's console; empty: no console")
    token: str = setting("", "File with the token that a console beyond loopback asks for, made by dappled keys token")
    hosts: tuple[str, ...] = setting((), "More names that browsers may reach the console by")
    map: str = setting(
        "", "Picture behind the track: PNG or JPEG with a world file in degrees beside it; empty: a grid"
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings, validated and resolved."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    mask: MaskSettings = field(default_factory=MaskSettings)
    mavlink: MavlinkSettings = field(default_factory=MavlinkSettings)
    record: RecordSettings = field(default_factory=RecordSettings)
    pose: PoseSettings = field(default_factory=PoseSettings)
    decode: DecodeSettings = field(default_factory=DecodeSettings)
    publish: PublishSettings = field(default_factory=PublishSettings)
    console: ConsoleSettings = field(default_factory=ConsoleSettings)


TABLES: dict[str, type] = {f.name: f.default_factory for f in dataclasses.fields(Settings)}  # type: ignore[misc]  # all are classes


def load(path: Path | None) -> Settings:
    """Settings from a file, or the defaults. Raises ConfigError with file, line, key and what to do."""
    if path is None:
        return resolve(Settings())
    tables, source = read_toml(path)
    return resolve(parse(tables, source), path.parent)


def parse(tables: Mapping[str, Any], source: Source) -> Settings:
    """Settings from TOML tables."""
    records: dict[str, Any] = {}
    for name, table in tables.items():
        if name not in TABLES:
            near = difflib.get_close_matches(name, TABLES, 1, 0.4)
            hint = f"did you mean [{near[0]}]?" if near else f"known: {', '.join(TABLES)}"
            raise ConfigError(f"{source.where('', name)} is not a known table; {hint}")
        if not isinstance(table, Mapping):
            raise ConfigError(f"{source.where('', name)} must be a table: write [{name}] on a line of its own")
        records[name] = build(TABLES[name], table, source, name)
    return Settings(**records)


def resolve(settings: Settings, beside: Path | None = None) -> Settings:
    """Paths made absolute (relative ones stand beside the file that names them) and endpoints filled in."""
    beside = (beside or Path.cwd()).absolute()

    def path(value: str) -> str:
        return str(beside / Path(value).expanduser()) if value else ""

    def profile(value: str) -> str:
        return path(value) if value.endswith(".toml") else value

    publish = settings.publish
    slices = publish.slices or f"ipc://{runtime_folder()}/slices"
    ask = publish.ask or (f"{slices}.ask" if slices.startswith("ipc://") else "")
    return dataclasses.replace(
        settings,
        camera=dataclasses.replace(settings.camera, profile=profile(settings.camera.profile)),
        mask=dataclasses.replace(settings.mask, profile=profile(settings.mask.profile)),
        mavlink=dataclasses.replace(settings.mavlink, keys=tuple(path(each) for each in settings.mavlink.keys)),
        record=dataclasses.replace(settings.record, directory=path(settings.record.directory)),
        decode=dataclasses.replace(
            settings.decode,
            calibration=path(settings.decode.calibration),
            white=path(settings.decode.white),
            dark=path(settings.decode.dark),
        ),
        publish=dataclasses.replace(
            publish, slices=slices, ask=ask, keys=path(publish.keys), clients=path(publish.clients)
        ),
        console=dataclasses.replace(
            settings.console, token=path(settings.console.token), map=path(settings.console.map)
        ),
    )


def runtime_folder() -> Path:
    """Where sockets live: systemd's RUNTIME_DIRECTORY, the user's runtime folder, or a private one in /tmp."""
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0])
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given) / "dappled"
    return Path(f"/tmp/dappled-{os.getuid()}")  # noqa: S108  # made 0700 and its owner checked before it is used


def of_tables(tables: Mapping[str, Any], name: str) -> Settings:
    """Settings from the tables that `to_tables` made, as they stand in the file `name`."""
    return parse(tables, Source(name))


def to_tables(settings: Settings) -> dict[str, Any]:
    """Settings as plain TOML values."""
    return {
        name: {k: list(value) if isinstance(value, tuple) else value for k, value in table.items() if value is not None}
        for name, table in dataclasses.asdict(settings).items()
    }


def describe() -> list[tuple[str, str, Any, Rule]]:
    """Every key: (table, key, default, rule)."""
    return [
        (name, f.name, f.default, f.metadata["rule"])
        for name, table in TABLES.items()
        for f in dataclasses.fields(table)
    ]
