"""Simulate everything around the daemon: a masked camera in a PTP/IP body, an autopilot, a ground station.

The daemon reaches them as it reaches real ones: libgphoto2 over TCP, MAVLink over UDP. Where the settings name the
profile canon-eos-450d, the camera is one of these with the mask that they name, else the reference camera. The seed
determines how the mask is installed, and the daemon is not given it; the calibration comes from a bench frame, as a
user would make it.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import socket
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import tomli_w

from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.optics import MaskedOptics
from dappled.decode.spectrum.plane import to_plane
from dappled.drivers.raw import reading
from dappled.errors import DappledError
from dappled.mocks.autopilot.autopilot import Autopilot, BootTime
from dappled.mocks.autopilot.ground_station import GroundStation
from dappled.mocks.autopilot.path import SPEED_M_S
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.scene.masked_camera import MaskedCamera, eos450d_camera, eos450d_f_number, reference_camera

LATENCY_MS, LATENCY_SIGMA_MS = 60.0, 15.0 / 3**0.5  # the body's is spread evenly over 60 ± 15 ms


@dataclass(frozen=True, slots=True)
class World:
    """What is simulated. `scale` is the sensor's side as a share of the reference camera's 2776 × 3688 px; `f_number`
    0 opens the lens, None stops it down until carriers show; `truth`, for tests, is a folder for the true values.
    `real`: with a round stop, a film printed 0.3 % too fine, and ground whose detail does not end with a slice's band.
    `overlapping`: the vehicle flies so slowly that frames overlap, however long this computer takes for each.
    `autopilot`: False where the links of the settings lead to one, such as ArduPilot in software in the loop."""

    seed: int = 1
    scale: float = 0.5
    f_number: float | None = None
    truth: Path | None = None
    autopilot: bool = True
    real: bool = False
    overlapping: bool = False


_APART_M = 1.6  # of frames that see 5.6 m along the way
_FRAME_BENCHES = 3.0  # a frame of the ground takes so many times as long as the bench's with its calibration
_ATTITUDE_SIGMA_DEG = 0.01  # the simulated autopilot knows its attitude; only its messages are rounded


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """The camera and mask that are simulated, by their profiles."""

    profile: str
    mask: str

    @classmethod
    def of(cls, settings: Settings) -> SimulatedCamera:
        """Those of the settings if they name a Canon EOS 450D, else the reference camera's. A 450D without a mask is
        simulated with the thesis' Mask 2."""
        if settings.camera.profile != EOS_450D:
            return cls(CAMERA, MASK)
        mask = settings.mask.profile
        return cls(EOS_450D, "mask-2" if mask in ("", profiles.LENSLET) else mask)

    def __str__(self) -> str:
        return f"a Canon EOS 450D with {self.mask}" if self.profile == EOS_450D else "a masked camera"

    def on_a_bench(self, world: World) -> MaskedCamera:
        """The camera before a white card. Raises DappledError for a mask that can't be simulated."""
        if self.profile != EOS_450D:
            return reference_camera(world.seed, scale=world.scale, scene="white", real=world.real)
        try:
            return eos450d_camera(world.seed, profiles.mask(self.mask).mask, scene="white", real=world.real)
        except ValueError as error:
            raise DappledError(f"mask.profile {self.mask!r} can't be simulated: {error}") from None

    def f_number(self, camera: MaskedCamera) -> float:
        """The stop that is flown with: carriers are seen, and the aperture is wide enough for views."""
        return eos450d_f_number(camera) if self.profile == EOS_450D else 2 * camera.optics.f_number


class Simulation:
    """The simulated surroundings of one daemon. Use as a context manager around it."""

    def __init__(self, world: World, settings: Settings, folder: Path) -> None:
        """`folder` takes the calibration file. Nothing runs yet."""
        self.world = world
        self.start_monotonic_ns = time.monotonic_ns()
        self._stack = ExitStack()
        self._autopilot_port, self._ground_port = free_port(), free_port()
        self._settings, self._folder = settings, folder
        self.rig = SimulatedCamera.of(settings)
        self._speed_m_s = SPEED_M_S

    def __enter__(self) -> Settings:
        """Start camera body and autopilot; returns the settings that make a daemon use them."""
        world, rig = self.world, self.rig
        camera = rig.on_a_bench(world)
        began_ns = time.monotonic_ns()
        calibration = write_calibration(camera, self._folder, rig.profile, rig.mask)
        if world.overlapping:
            self._speed_m_s = overlapping_m_s((time.monotonic_ns() - began_ns) / 1e9)
        stop = rig.f_number(camera) if world.f_number is None else world.f_number or None
        with ExitStack() as stack:
            self.body = body = SimulatedBody.start(
                BodyOptions(
                    seed=world.seed,
                    serial=f"{SERIAL}{world.seed:08d}",
                    scale=world.scale,
                    mask=rig.mask if rig.profile == EOS_450D else "",
                    f_number=stop,
                    start_monotonic_ns=self.start_monotonic_ns,
                    truth=str(world.truth or ""),
                    real=world.real,
                    speed_m_s=self._speed_m_s,
                )
            )
            stack.callback(body.stop)
            if world.autopilot:
                self._autopilot = self._start_autopilot()
                stack.callback(self._stop_autopilot)
            self._stack = stack.pop_all()
        given = self._settings
        ports = (self._autopilot_port, self._ground_port) if world.autopilot else (self._ground_port,)
        links = tuple(f"udpin:127.0.0.1:{port}" for port in ports)
        knows_attitude = _ATTITUDE_SIGMA_DEG if world.autopilot else 0.0
        return replace(
            given,
            camera=replace(
                given.camera,
                driver="gphoto2",
                port=body.port,
                profile=rig.profile,
                serial="",
                shutter="",
                pickup="",
                options=None,
                delete_after_download=True,  # its card is in memory
                latency_ms=LATENCY_MS,
                latency_sigma_ms=LATENCY_SIGMA_MS,
            ),
            mask=replace(given.mask, profile=rig.mask),
            mavlink=replace(given.mavlink, url=(*links, *given.mavlink.url), keys=_keys(given, len(links))),
            pose=replace(given.pose, attitude_sigma_deg=given.pose.attitude_sigma_deg or knows_attitude),
            decode=replace(given.decode, calibration=str(calibration), white="", dark=""),
        )

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def autopilot_url(self) -> str:
        """The URL that the autopilot sends to."""
        return f"udpout:127.0.0.1:{self._autopilot_port}"

    @property
    def ground_url(self) -> str:
        """The URL at which a ground station finds the daemon."""
        return f"udpout:127.0.0.1:{self._ground_port}"

    def _start_autopilot(self, booted_s: float = BootTime().offset_s) -> Autopilot:
        return Autopilot.start(
            self.autopilot_url,
            seed=self.world.seed,
            start_monotonic_ns=self.start_monotonic_ns,
            booted_s=booted_s,
            more=[f"--speed={self._speed_m_s}"],
        )

    def _stop_autopilot(self) -> None:
        self._autopilot.stop()

    def ground_station(self, frames: int, interval_s: float = 0.0) -> GroundStation:
        """Start a ground station that requests this many frames, each after the last one ended."""
        station = GroundStation.start(self.ground_url, frames, interval_s)
        self._stack.callback(station.stop)
        return station


def overlapping_m_s(bench_s: float) -> float:
    """The speed at which frames of the ground overlap, on a computer that took so long for the bench's frame and its
    calibration."""
    return min(SPEED_M_S, _APART_M / (_FRAME_BENCHES * bench_s))


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A free port of loopback, for UDP or as `kind` says.

    It lies outside the range from which the kernel assigns ports, a process gives none twice, and processes beside each
    other begin at different ones: so it is still free when it is bound.
    """
    last = _first_given_out() - 1
    first = max(1024, last - 12_000)  # above the ports of common services
    for _ in range(1000):
        port = first + (os.getpid() * 64 + next(_given)) % (last - first + 1)
        with socket.socket(socket.AF_INET, kind) as one, contextlib.suppress(OSError):
            one.bind(("127.0.0.1", port))
            return port
    raise OSError(errno.EADDRINUSE, f"no port of loopback between {first} and {last} is free")


_given = itertools.count()


def _first_given_out() -> int:
    return int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text("ascii").split()[0])


def _keys(given: Settings, simulated: int) -> tuple[str, ...]:
    """Signing keys for all links: the simulated ones, which come first and are not signed, and the user's."""
    return (*[""] * simulated, *given.mavlink.link_keys) if given.mavlink.keys else ()


CAMERA, MASK = "reference-36mm", "reference-5x5"
"""The shipped profiles of the reference camera."""

EOS_450D = "canon-eos-450d"

SERIAL = "SIM"
"""The serial number of a simulated body begins with this, in flight.toml and in its files."""

REPLACED = frozenset(
    {("camera", key) for key in ("driver", "port", "profile", "serial", "shutter", "pickup", "options")}
    | {("camera", key) for key in ("delete_after_download", "latency_ms", "latency_sigma_ms")}
    | {("mask", "profile"), ("mavlink", "url"), ("mavlink", "keys"), ("pose", "attitude_sigma_deg")}
    | {("decode", key) for key in ("calibration", "white", "dark")}
)
"""(table, key) of the settings that a simulation replaces."""


def write_calibration(camera: MaskedCamera, folder: Path, profile_name: str = CAMERA, mask_name: str = MASK) -> Path:
    """Calibrate with the bench frame of a simulated camera, as `dappled calibrate` does; returns the file."""
    raw = reading.read(camera.bench_frame().file, "bench frame")
    profile = profiles.camera(profile_name)
    plane = to_plane(raw.mosaic, black=raw.black, white=raw.white, cfa=raw.cfa)
    assert raw.focal_length_mm is not None  # the simulated camera writes both into its files
    assert raw.f_number is not None
    found = calibrate(
        [CalibrationFrame(plane, raw.focal_length_mm, raw.f_number)],
        MaskedOptics(
            profile.sensor((plane.shape[0], plane.shape[1])),
            profiles.mask(mask_name).mask,
            profile.law,
            profile.mask_distance_mm,
        ),
    )
    path = folder / "calibration.toml"
    path.write_text(tomli_w.dumps(found.to_dict()), encoding="utf-8")
    return path
