"""Simulate everything around the daemon: a masked camera in a PTP/IP body, an autopilot, a ground station.

The daemon reaches them as it reaches real ones: libgphoto2 over TCP, MAVLink over UDP. The seed determines how the mask
is installed, and the daemon is not given it; the calibration comes from a bench frame, as a user would make it.
"""

from __future__ import annotations

import contextlib
import errno
import secrets
import socket
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import tomli_w

from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.spectrum.plane import to_plane
from dappled.drivers.raw import reading
from dappled.mocks.autopilot.autopilot import Autopilot
from dappled.mocks.autopilot.ground_station import GroundStation
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.scene.masked_camera import MaskedCamera, reference_camera

LATENCY_MS, LATENCY_SIGMA_MS = 60.0, 15.0 / 3**0.5  # the body's is spread evenly over 60 ± 15 ms


@dataclass(frozen=True, slots=True)
class World:
    """What is simulated. `scale` is the sensor's side as a share of the reference camera's 2776 × 3688 px; `f_number`
    0 opens the lens; `truth`, for tests, is a folder for the true values."""

    seed: int = 1
    scale: float = 0.5
    f_number: float = 14.8
    truth: Path | None = None


_ATTITUDE_SIGMA_DEG = 0.01  # the simulated autopilot knows its attitude; only its messages are rounded


class Simulation:
    """The simulated surroundings of one daemon. Use as a context manager around it."""

    def __init__(self, world: World, settings: Settings, folder: Path) -> None:
        """`folder` takes the calibration file. Nothing runs yet."""
        self.world = world
        self.start_monotonic_ns = time.monotonic_ns()
        self._stack = ExitStack()
        self._autopilot_port = free_port()
        self._ground_port = next(port for port in iter(free_port, None) if port != self._autopilot_port)
        self._settings, self._folder = settings, folder

    def __enter__(self) -> Settings:
        """Start camera body and autopilot; returns the settings that make a daemon use them."""
        world = self.world
        camera = reference_camera(world.seed, scale=world.scale, scene="white")
        calibration = write_calibration(camera, self._folder)
        with ExitStack() as stack:
            self.body = body = SimulatedBody.start(
                BodyOptions(
                    seed=world.seed,
                    scale=world.scale,
                    f_number=world.f_number or None,
                    start_monotonic_ns=self.start_monotonic_ns,
                    truth=world.truth,
                )
            )
            stack.callback(body.stop)
            self._autopilot = Autopilot.start(
                self.autopilot_url, seed=world.seed, start_monotonic_ns=self.start_monotonic_ns
            )
            stack.callback(self._stop_autopilot)
            self._stack = stack.pop_all()
        given = self._settings
        links = (f"udpin:127.0.0.1:{self._autopilot_port}", f"udpin:127.0.0.1:{self._ground_port}", *given.mavlink.url)
        return replace(
            given,
            camera=replace(
                given.camera,
                driver="gphoto2",
                port=body.port,
                profile=CAMERA,
                serial="",
                shutter="",
                pickup="",
                options=None,
                delete_after_download=True,  # its card is in memory
                latency_ms=LATENCY_MS,
                latency_sigma_ms=LATENCY_SIGMA_MS,
            ),
            mask=replace(given.mask, profile=MASK),
            mavlink=replace(given.mavlink, url=links, keys=_keys(given)),
            pose=replace(given.pose, attitude_sigma_deg=given.pose.attitude_sigma_deg or _ATTITUDE_SIGMA_DEG),
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

    def reboot_autopilot(self) -> None:
        """Restart the autopilot: its time since boot starts again, and the flight goes on."""
        self._autopilot.stop()
        self._autopilot = Autopilot.start(
            self.autopilot_url,
            seed=self.world.seed,
            start_monotonic_ns=self.start_monotonic_ns,
            booted_s=-(time.monotonic_ns() - self.start_monotonic_ns) / 1e9,
        )

    def _stop_autopilot(self) -> None:
        self._autopilot.stop()

    def ground_station(self, frames: int, interval_s: float = 0.0) -> GroundStation:
        """Start a ground station that requests this many frames, each after the last one ended."""
        station = GroundStation.start(self.ground_url, frames, interval_s)
        self._stack.callback(station.stop)
        return station


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A free port of loopback, for UDP or as `kind` says.

    It lies outside the range from which the kernel assigns ports, so it is still free when it is bound.
    """
    last = _first_given_out() - 1
    first = max(1024, last - 12_000)  # above the ports of common services
    for _ in range(1000):
        port = first + secrets.randbelow(last - first + 1)
        with socket.socket(socket.AF_INET, kind) as one, contextlib.suppress(OSError):
            one.bind(("127.0.0.1", port))
            return port
    raise OSError(errno.EADDRINUSE, f"no port of loopback between {first} and {last} is free")


def _first_given_out() -> int:
    return int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text("ascii").split()[0])


def _keys(given: Settings) -> tuple[str, ...]:
    """Signing keys for all links: the simulated ones, which are not signed, and the user's."""
    keys, links = given.mavlink.keys, len(given.mavlink.url)
    if not keys:
        return ()
    return ("", "", *(keys * links if len(keys) == 1 else keys))


CAMERA, MASK = "reference-36mm", "reference-5x5"
"""The shipped profiles of the reference camera."""


def write_calibration(camera: MaskedCamera, folder: Path) -> Path:
    """Calibrate with the bench frame of a reference camera, as `dappled calibrate` does; returns the file."""
    raw = reading.read(camera.bench_frame().file, "bench frame")
    profile = profiles.camera(CAMERA)
    plane = to_plane(raw.mosaic, black=raw.black, white=raw.white, cfa=raw.cfa)
    assert raw.focal_length_mm is not None  # the simulated camera writes both into its files
    assert raw.f_number is not None
    found = calibrate(
        [CalibrationFrame(plane, raw.focal_length_mm, raw.f_number)],
        sensor=profile.sensor((plane.shape[0], plane.shape[1])),
        mask=profiles.mask(MASK).mask,
        law=profile.law,
        mask_distance_mm=profile.mask_distance_mm,
    )
    path = folder / "calibration.toml"
    path.write_text(tomli_w.dumps(found.to_dict()), encoding="utf-8")
    return path
