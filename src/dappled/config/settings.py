"""The settings file: every key with its default, unit and range. With an empty file and a camera the daemon works."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.config.schema import BadSetting, Rule, TomlSource, examine, read_toml, refuse, setting

LAW_NAMES = ("fd", "geometric")
DEPTH_METHODS = ("contrast", "combined")
SIMULATED_FLIGHTS = Path("flights")  # where `dappled run --simulate` records without a file
SOCKET_MODES = ("0600", "0660", "0666")


@dataclass(frozen=True, slots=True)
class CameraSettings:
    driver: str = setting(
        "gphoto2", "Driver by name: gphoto2, fujifilm, folder, simulated, or one that another package registers"
    )
    profile: str = setting("auto", "Camera profile by name or TOML file; auto chooses by the model named in the frame")
    serial: str = setting("", "Use only the body with this serial number; empty: the first found")
    port: str = setting("", "libgphoto2 port, such as usb: or ptpip:127.0.0.1:15740:15740; empty: the first found")
    capture_target: str = setting("card", "Where the body stores a file until it is fetched", choices=("card", "ram"))
    delete_after_download: bool = setting(
        False, "Delete a file from the card once it is safe on disk; otherwise the card is a second copy"
    )
    shutter: str = setting(
        "",
        "Shutter of fujifilm and folder: gpio:CHIP:LINE, servo:OUTPUT:PRESSED:RELEASED, relay:NUMBER, autopilot, "
        "outside",
    )
    pickup: str = setting(
        "", "Where fujifilm and folder get the files from: later, storage, a libgphoto2 port, or a folder"
    )
    options: dict[str, Any] | None = setting(None, "A table of the driver's own options")  # noqa: RUF009  the default is None; the driver checks them
    latency_ms: float = setting(
        60.0, "Time from the trigger call to the start of the exposure", unit="ms", low=0, high=5000
    )
    latency_sigma_ms: float = setting(30.0, "Standard deviation of latency_ms", unit="ms", low=0, high=5000)
    max_pending: int = setting(
        2, "Shots that may be pending at once; further capture requests are refused", low=1, high=1000
    )
    file_timeout_s: float = setting(
        30.0, "A shot fails when its file has not come after this time", unit="s", low=1, high=3600
    )

    @property
    def fired_outside(self) -> bool:
        """Whether something else fires the camera: it can't be fired from here, and is told of exposures instead."""
        return self.shutter == "outside" or (self.driver == "folder" and not self.shutter)


@dataclass(frozen=True, slots=True)
class PlannedBody:
    check: str = setting(
        "set",
        "A body that is not as planned when it is opened: set (what it lets be set; the rest is told); tell; off",
        choices=("set", "tell", "off"),
    )
    exposure_mode: str = setting("manual", "Exposure mode: manual, or the body's own word (AV); empty: any")
    focus_mode: str = setting("manual", "Focus mode: manual, or the body's own word; empty: any")
    drive_mode: str = setting("single", "Drive mode: single, or the body's own word; empty: any")
    white_balance: str = setting(
        "", "White balance in the body's own word (Daylight); empty: any, raw files keep it out"
    )
    image_format: str = setting("raw", "Image format: raw, or the body's own words (L + RAW); empty: any")
    auto_power_off: str = setting("off", "Automatic power-off: off, or the body's own word; empty: any")
    mirror_lockup: str = setting("off", "Mirror lock-up: off or on; empty: any")
    iso: str = setting("", 'ISO, such as "400"; empty: as the body has it')
    shutter_speed: str = setting("", 'Exposure time, such as "1/1000"; empty: as the body has it')
    aperture: str = setting("", 'F-number, such as "5.6"; empty: as the body has it')
    focal_length_mm: float = setting(
        0.0, "Focal length that each frame's EXIF is compared with; 0: any", unit="mm", low=0, high=10_000
    )


@dataclass(frozen=True, slots=True)
class MaskSettings:
    profile: str = setting(
        "", "Mask profile by name or TOML file, or lenslet; empty: frames are recorded but not decoded"
    )


@dataclass(frozen=True, slots=True)
class MavlinkSettings:
    url: tuple[str, ...] = setting((), "pymavlink connection string, or a list of them; empty: no link and no poses")
    component_id: int = setting(100, "MAVLink component id; autopilots look for cameras at 100 to 105", low=1, high=255)
    system_id: int = setting(
        1, "MAVLink system id until an autopilot is heard; then the autopilot's is used", low=1, high=255
    )
    keys: tuple[str, ...] = setting(
        (), 'Signing key files (dappled mavlink key), one for each url in order, "" for none; a single one is for all'
    )
    unsigned: str = setting(
        "refuse",
        "Packets without a signature on a link with a key: refuse; listen (read, but not obeyed); or allow",
        choices=("refuse", "listen", "allow"),
    )
    unsigned_parameters: bool = setting(
        False,
        "Take the settings that end a flight or change its decoding (LF_MASK, LF_LAW, LF_DECODE, CAM_FORMAT, "
        "CAM_FOCALLEN) over unsigned UDP and TCP links off loopback, too",
    )
    feedback_is_shot: bool = setting(
        False,
        "The autopilot fires the camera by wire, and each of its CAMERA_FEEDBACK messages is a shot; always so, and "
        'only, where something else fires it: camera.shutter = "outside", or the driver folder without a shutter',
    )
    autopilot_camera: int = setting(
        0,
        "Which camera of the autopilot this one is: 1 for CAM1, 2 for CAM2 …; 0: by component_id (100 is CAM1)",
        low=0,
        high=9,
    )

    @property
    def link_keys(self) -> tuple[str, ...]:
        """The key file of each url in order, "" for none, where `keys` names none, one, or one for each url."""
        return self.keys * len(self.url) if len(self.keys) == 1 else self.keys or ("",) * len(self.url)

    @property
    def cam_idx(self) -> int:
        """The camera's number in CAMERA_FEEDBACK, from 0."""
        if self.autopilot_camera:
            return self.autopilot_camera - 1
        return self.component_id - 100 if 100 <= self.component_id <= 105 else 0


@dataclass(frozen=True, slots=True)
class RecordSettings:
    directory: str = setting("~/flights", "Folder for the flights, one folder each")
    utc: str = setting(
        "auto",
        "Source of UTC: system; autopilot (learnt in flight, folders named by boot); auto: system if it is plausible",
        choices=("auto", "system", "autopilot"),
    )
    warn_free_mb: int = setting(
        2000, "Warn when less disk space than this is free; 0: never", unit="MB", low=0, high=10_000_000
    )
    min_free_mb: int = setting(
        500, "Refuse new shots when less disk space than this is free; 0: never", unit="MB", low=0, high=10_000_000
    )
    seal_key: str = setting(
        "", "Key file that signs the seals of flights, made by dappled keys seal; empty: seals are not signed"
    )


@dataclass(frozen=True, slots=True)
class TriggerSettings:
    distance_m: float = setting(
        0.0, "Way over ground from one photograph to the next; 0: by overlap", unit="m", low=0, high=10_000
    )
    overlap: float = setting(
        0.0,
        "Share of a photograph's ground, along the way, that the next one sees too; 0: by distance_m. A vehicle "
        "too fast for it is told, whoever asks for the photographs",
        low=0,
        high=0.95,
    )
    from_height_m: float = setting(
        0.0,
        "Height above the take-off place from which on these photographs are taken, until the vehicle is a fifth "
        "lower; 0: only when a ground station asks for them",
        unit="m",
        low=0,
        high=10_000,
    )


@dataclass(frozen=True, slots=True)
class GnssSettings:
    port: str = setting(
        "",
        "Serial port of a u-blox receiver, DEVICE[,BAUD]: its raw stream is recorded for PPK, and its time marks time "
        "exposures; empty: none",
    )
    edge: str = setting("falling", "Edge at its EXTINT where the exposure begins", choices=("falling", "rising"))


@dataclass(frozen=True, slots=True)
class PoseSettings:
    wait_ms: float = setting(
        700.0, "How long a tag waits for telemetry after the exposure", unit="ms", low=0, high=10_000
    )
    attitude_sigma_deg: float = setting(
        0.0,
        "Least standard deviation of the attitude; the autopilot may send a larger one. 0: as the autopilot sends it",
        unit="°",
        low=0,
        high=90,
    )
    lever_arm_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Vector from the antenna to the camera: forward, right, down", unit="m", low=-100, high=100
    )
    mount: tuple[float, float, float, float, float, float, float, float, float] = setting(
        (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "Rotation from camera axes (right, down, forward) to body axes, row by row; default: down, image top forward",
        low=-1,
        high=1,
    )
    on_gimbal: bool = setting(
        False, "The camera is on the gimbal: use the gimbal's attitude; mount then leads to the gimbal's axes"
    )


@dataclass(frozen=True, slots=True)
class DecodeSettings:
    enabled: bool = setting(True, "Decode in flight; recorded frames can also be decoded later")
    law: str = setting("", "Carrier law; empty: the camera profile's", choices=("", *LAW_NAMES))
    calibration: str = setting(
        "", "File written by dappled calibrate; empty: carriers are predicted from the profiles alone"
    )
    white: str = setting("", "White frame; empty: none")
    dark: str = setting("", "Dark frame; empty: none")
    workers: int = setting(
        1, "Threads that decode one frame; with 1, a two-core board keeps a core for capture", low=1, high=64
    )
    depth: str = setting("", "Method of depth maps in flight; empty: no depth maps", choices=("", *DEPTH_METHODS))
    depth_to_autopilot: bool = setting(
        False, "Send the nearest distance as DISTANCE_SENSOR; needs a calibration with targets at known distances"
    )
    depth_interval_s: float = setting(
        5.0, "Shortest time between two depth maps; 0: one for every frame", unit="s", low=0, high=3600
    )
    queue: int = setting(
        4,
        "Frames that may wait for decoding; further ones stay in the record and can be decoded later",
        low=1,
        high=1000,
    )


@dataclass(frozen=True, slots=True)
class PublishSettings:
    slices: str = setting("", "ZeroMQ endpoint of the stream; empty: ipc in the user's runtime folder")
    ask: str = setting("", "ZeroMQ endpoint that answers requests for recorded frames; empty: beside the stream")
    high_water_mark: int = setting(
        3, "Messages (each a frame's slices) that may wait for a slow subscriber", low=1, high=1000
    )
    preview_interval_s: float = setting(
        1.0, "Shortest time between two previews; 0: one for every frame", unit="s", low=0, high=3600
    )
    picture_interval_s: float = setting(
        5.0,
        "Shortest time between two pictures at the sensor's own resolution, which are made for who subscribes to them",
        unit="s",
        low=0,
        high=3600,
    )
    socket_mode: str = setting("0660", "Permissions of ipc sockets, as for chmod", choices=SOCKET_MODES)
    keys: str = setting(
        "", "Secret CURVE key for tcp endpoints, made by dappled keys make; empty: tcp on loopback only"
    )
    clients: str = setting("", "Folder with the public keys (NAME.key) of those who may subscribe over tcp")


@dataclass(frozen=True, slots=True)
class ConsoleSettings:
    bind: str = setting("", "host:port of the operator's console; empty: no console")
    token: str = setting("", "File with the token that a console off loopback requires, made by dappled keys token")
    hosts: tuple[str, ...] = setting((), "Further host names under which browsers may open the console")
    map: str = setting("", "Map behind the track: PNG or JPEG with a world file in degrees beside it; empty: a grid")
    area: str = setting("", "Planned area: GeoJSON, KML or a QGroundControl .plan; the map then shows its holes")


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings, validated and resolved."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    body: PlannedBody = field(default_factory=PlannedBody)
    mask: MaskSettings = field(default_factory=MaskSettings)
    mavlink: MavlinkSettings = field(default_factory=MavlinkSettings)
    record: RecordSettings = field(default_factory=RecordSettings)
    trigger: TriggerSettings = field(default_factory=TriggerSettings)
    gnss: GnssSettings = field(default_factory=GnssSettings)
    pose: PoseSettings = field(default_factory=PoseSettings)
    decode: DecodeSettings = field(default_factory=DecodeSettings)
    publish: PublishSettings = field(default_factory=PublishSettings)
    console: ConsoleSettings = field(default_factory=ConsoleSettings)


TABLES: dict[str, type] = {f.name: f.default_factory for f in dataclasses.fields(Settings)}  # type: ignore[misc]  # all are classes


@dataclass(frozen=True, slots=True)
class SettingsFile:
    """Settings as far as a file has them right, the file for error sentences, and what is wrong in it."""

    settings: Settings
    source: TomlSource
    findings: tuple[BadSetting, ...] = ()


def load(path: Path | None) -> Settings:
    """Settings from a file, or the defaults. Raises ConfigError: all that is wrong, with line, key and what to do."""
    read = examine_file(path)
    refuse(read.findings)
    return read.settings


def examine_file(path: Path | None) -> SettingsFile:
    """Read a file, or the defaults, with a finding for each thing that is wrong in it. Raises ConfigError where it
    can't be read or is not TOML."""
    if path is None:
        return SettingsFile(resolve(Settings()), TomlSource("the built-in settings"))
    tables, source = read_toml(path)
    settings, findings = _examine_tables(tables, source)
    return SettingsFile(resolve(settings, path.parent), source, tuple(findings))


def parse(tables: Mapping[str, Any], source: TomlSource) -> Settings:
    """Settings from TOML tables. Raises ConfigError."""
    settings, findings = _examine_tables(tables, source)
    refuse(findings)
    return settings


def _other_kind(tables: Mapping[str, Any]) -> str:
    """What a file is instead of settings, and where settings name it; "" where it may be settings."""
    if tables.get("kind") == "dappled calibration":
        return "a calibration, no settings: name it in a settings file, as calibration in [decode]"
    if "frequency_per_mm" in tables or "period_px" in tables:
        return "a mask's profile, no settings: name it in a settings file, as profile in [mask]"
    if "raw" in tables and not tables.keys() & TABLES.keys():
        return "a camera's profile, no settings: name it in a settings file, as profile in [camera]"
    return ""


def _examine_tables(tables: Mapping[str, Any], source: TomlSource) -> tuple[Settings, list[BadSetting]]:
    if other := _other_kind(tables):
        return Settings(), [BadSetting("", "", f"{source.name} is {other}")]
    records: dict[str, Any] = {}
    findings: list[BadSetting] = []
    for name, table in tables.items():
        if name not in TABLES:
            near = codec.nearest(name, TABLES)
            hint = f"did you mean [{near}]?" if near else f"known: {', '.join(TABLES)}"
            findings.append(BadSetting(name, "", f"{source.where('', name)} is not a known table; {hint}"))
        elif not isinstance(table, Mapping):
            text = f"{source.where('', name)} must be a table: write [{name}] on a line of its own"
            findings.append(BadSetting(name, "", text))
        else:
            records[name], more = examine(TABLES[name], table, source, name)
            findings += more
    return Settings(**records), findings


def resolve(settings: Settings, beside: Path | None = None) -> Settings:
    """Make paths absolute (relative to the folder `beside` of the settings file) and fill in the endpoints."""
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
        record=dataclasses.replace(
            settings.record, directory=path(settings.record.directory), seal_key=path(settings.record.seal_key)
        ),
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
            settings.console,
            token=path(settings.console.token),
            map=path(settings.console.map),
            area=path(settings.console.area),
        ),
    )


def runtime_folder() -> Path:
    """The folder for sockets: systemd's RUNTIME_DIRECTORY, the user's runtime folder, or a private one in /tmp."""
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0])
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given) / "dappled"
    return Path(f"/tmp/dappled-{os.getuid()}")  # noqa: S108  # made 0700 and its owner checked before it is used


def of_tables(tables: Mapping[str, Any], name: str) -> Settings:
    """Settings from tables that `to_tables` made; `name` is the file that holds them."""
    return parse(tables, TomlSource(name))


def to_tables(settings: Settings) -> dict[str, Any]:
    """Settings as plain TOML values."""
    tables: dict[str, Any] = codec.table(settings)
    return tables


def describe() -> list[tuple[str, str, Any, Rule]]:
    """Every key: (table, key, default, rule)."""
    return [
        (name, f.name, f.default, f.metadata["rule"])
        for name, table in TABLES.items()
        for f in dataclasses.fields(table)
    ]
