"""How many bad frames the verdicts in flight find, and how many good ones they call bad.

Motion: a simulated vehicle sways over ground that is up to 3 % (1 σ) nearer or farther than its take-off place; its
telemetry has noise, and comes 10 (position) and 25 (attitude) times a second. The true blur is how far ground points
move over the sensor while the shutter is open, by the simulator's own path. Defocus: pictures of random discs and
boxes, and of ground without edges, four kinds a flight, blurred by a true disc at three times the resolution, cut to a
slice's band, with noise and a little motion. Clipping: mosaics with a known share of white. Severities are drawn
evenly: 0 to 3 pixels of a view, 0 to 10 %. What lies near the bound (0.8 to 1.25 pixels; 4 to 6.25 %) is counted apart.

python benchmarks/verdicts.py [--json] [--frames 600] [--seed 1]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from limits import show
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import j1

from dappled.config.profiles import VerdictBounds
from dappled.daemon.navigation import Telemetry
from dappled.daemon.pipeline.picture_facts import PictureFacts, detail, noise_of
from dappled.daemon.pipeline.verdicts import Judge
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.drivers.raw.raw_file import RawFile, exposure
from dappled.flight import Tag, TimeSource
from dappled.mocks.autopilot.autopilot import telemetry_message
from dappled.mocks.autopilot.path import FlightPath, TruePose

Grey = NDArray[np.float64]
BAND = (0.8, 1.25)
NADIR = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
START_NS = 1_790_000_000 * 10**9
FOCAL_MM, SIDE_MM, VIEW_MM = 20.0, (14.8, 22.2), (0.031, 0.031)
EVERY_S, WARM_UP_S = 1.3, 5.0
VELOCITY_SIGMA_M_S, RATE_SIGMA_RAD_S, GROUND_SIGMA, TIME_SIGMA_S = 0.1, 0.01, 0.03, 0.005
NOISE = 0.01  # of the mean, in a slice
FLIGHT, SHARP_FIRST = 60, 10  # frames of a flight; of these the first are in focus
VIEW, FINER = 112, 3  # side of a slice, and how much finer its ground is drawn
SHARP = PictureFacts(0.0, 0.0, 0.2, ((0.5, 1.0, 2.0),) * 2, 0.0, SIDE_MM, VIEW_MM, (0.0052, 0.0052))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    show("verdicts", measure(arguments.frames, arguments.seed), as_json=arguments.json)


def measure(frames: int, seed: int) -> dict[str, dict[str, float]]:
    """By cause: `found` of the truly bad frames, `false` of the others, `band_bad` the share called bad between, how
    many frames each is of, and `auc`, the area under the curve of all bounds."""
    return {name: figures(list(pairs), bound, truly) for name, (pairs, bound, truly) in causes(frames, seed).items()}


def causes(frames: int, seed: int) -> dict[str, tuple[Iterator[tuple[float, float]], float, float]]:
    """By cause: (true, judged) severities, made as they are read; the bound; and what is truly bad."""
    bounds = VerdictBounds()
    return {
        "motion": (motion(frames, seed), bounds.blur_bad_px, 1.0),
        "defocus": (defocus(frames, seed), bounds.defocus_bad_px, 1.0),
        "clipping": (clipping(frames, seed), bounds.clipped_bad, 0.05),
    }


def figures(pairs: list[tuple[float, float]], bound: float, truly: float) -> dict[str, float]:
    """From (true, judged) severities; frames are called bad above `bound`, and are so above `truly`."""
    true, judged = np.array(pairs).T
    low, high = (edge * truly for edge in BAND)
    bad, fine, band = judged[true > high], judged[true < low], judged[(true >= low) & (true <= high)]
    return {
        "found": float(np.mean(bad > bound)),
        "false": float(np.mean(fine > bound)),
        "band_bad": float(np.mean(band > bound)),
        "bad_frames": len(bad),
        "fine_frames": len(fine),
        "band_frames": len(band),
        "auc": float(np.mean(bad[:, None] > fine[None, :])),
        "median_error": float(np.median(np.abs(judged - true))),
    }


def curve(pairs: list[tuple[float, float]], truly: float, bounds: Iterable[float]) -> list[tuple[float, float, float]]:
    """(bound, found, false) for each bound."""
    return [(one, (made := figures(pairs, one, truly))["found"], made["false"]) for one in bounds]


def motion(frames: int, seed: int) -> Iterator[tuple[float, float]]:
    """(true, predicted) blur of frames in pixels of a view."""
    rng = np.random.default_rng(seed)
    path = FlightPath(seed, height_m=40.0, speed_m_s=6.0, radius_m=25.0)
    telemetry, judge, number = Telemetry(), Judge(NADIR, on_gimbal=False), 0
    packets = _packets(path, WARM_UP_S + frames * EVERY_S + 1, rng)
    stamp_s, message = next(packets)
    for index in range(frames):
        middle_s = WARM_UP_S + index * EVERY_S
        while stamp_s < middle_s + 0.5:
            telemetry.feed(number, (START_NS + round(stamp_s * 1e9)) // 1000, message)
            number += 1
            stamp_s, message = next(packets)
        ground_m = rng.normal(0, GROUND_SIGMA) * 40.0  # above the take-off place
        fast = _moved(path, middle_s, 2e-3, ground_m) / 2e-3
        exposure_s = float(rng.uniform(0, 3)) / fast
        true = _moved(path, middle_s, exposure_s, ground_m)
        pose = telemetry.pose_at(START_NS + round((middle_s + rng.normal(0, TIME_SIGMA_S)) * 1e9), 0.0)
        tag = Tag(index, 0, 0, TimeSource.HOT_SHOE, FOCAL_MM, 8.0, exposure_s, 100.0, "", "", "0" * 64, pose)
        facts = judge.judge(tag, telemetry.rates(pose), SHARP, carriers=(24, 24), doubts=()).facts
        assert facts is not None
        assert facts.blur_view_px is not None, facts.blur_unknown
        yield true, facts.blur_view_px


def _packets(path: FlightPath, stop_s: float, rng: np.random.Generator) -> Iterator[tuple[float, MavlinkMessage]]:
    """Telemetry with noise: (when it arrives, message)."""
    rates_hz = {mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 25}
    events = sorted((step / rate, name) for name, rate in rates_hz.items() for step in range(int(stop_s * rate)))
    for t_s, name in events:
        pose = path.pose(t_s)
        velocity = np.array(pose.velocity_ned_m_s) + rng.normal(0, VELOCITY_SIGMA_M_S, 3)
        turn = np.array(pose.rates_body_rad_s) + rng.normal(0, RATE_SIGMA_RAD_S, 3)
        noisy = replace(pose, velocity_ned_m_s=tuple(velocity.tolist()), rates_body_rad_s=tuple(turn.tolist()))
        message = telemetry_message(name, noisy, round(t_s * 1e9))
        message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
        yield t_s + 0.02, message


def _moved(path: FlightPath, middle_s: float, exposure_s: float, ground_m: float) -> float:
    """How far a ground point moves over the sensor at most while the shutter is open, pixels of a view."""
    corners = [(y, x) for y in (-0.5, 0.0, 0.5) for x in (-0.5, 0.0, 0.5)]
    rays = np.array([(x * SIDE_MM[1], y * SIDE_MM[0], FOCAL_MM) for y, x in corners])
    middle = path.pose(middle_s)
    turn, place = _turn(middle), np.array(middle.position_ned_m)
    ned = rays @ turn.T
    ground = place + ned * ((-ground_m - place[2]) / ned[:, 2])[:, None]
    seen = []
    for t_s in middle_s + exposure_s * np.linspace(-0.5, 0.5, 9):
        pose = path.pose(float(t_s))
        camera = (ground - np.array(pose.position_ned_m)) @ _turn(pose)
        seen.append(camera[:, :2] / camera[:, 2:] * FOCAL_MM / np.array(VIEW_MM)[::-1])
    track = np.stack(seen)
    apart = np.linalg.norm(track[:, None] - track[None, :], axis=-1)
    return float(apart.max())


def _turn(pose: TruePose) -> Grey:
    """(3, 3) from camera axes (right, down, forward) to north-east-down."""
    w, x, y, z = pose.attitude
    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix() @ np.array(NADIR).reshape(3, 3))


def defocus(frames: int, seed: int) -> Iterator[tuple[float, float]]:
    """(true, judged) diameters of the circle of confusion in pixels of a view; the sharp first frames of each flight
    are not among them."""
    rng = np.random.default_rng(seed + 1000)
    given = 0
    while given < frames:
        steepness = rng.uniform(2.6, 3.1)
        grounds = [_leaves(rng, steepness + rng.uniform(-0.1, 0.1)) for _ in range(2)]
        grounds += [_terrain(rng, slope) for slope in rng.uniform(1.5, 3.0, 2)]
        judge = Judge(NADIR, on_gimbal=False)
        for number in range(SHARP_FIRST + FLIGHT):
            true = float(rng.uniform(0, 0.3) if number < SHARP_FIRST else rng.uniform(0, 3))
            picture = _photograph(rng, grounds[rng.integers(len(grounds))], true)
            sigma = NOISE * float(picture.mean())
            picture += rng.normal(0, sigma, picture.shape)
            seen = replace(SHARP, detail=detail(picture), noise=noise_of(picture, sigma))
            tag = Tag(
                number, 0, 0, TimeSource.HOT_SHOE, None, None, None, None, "", "", "0" * 64, Telemetry().pose_at(0, 0)
            )
            facts = judge.judge(tag, None, seen, carriers=(None, 24), doubts=()).facts
            assert facts is not None
            if number >= SHARP_FIRST and given < frames:
                given += 1
                assert facts.defocus_view_px is not None
                yield true, facts.defocus_view_px


def _leaves(rng: np.random.Generator, steepness: float) -> NDArray[np.float32]:
    """Ground of discs and boxes over each other, sizes by a power law (the dead leaves of image statistics)."""
    side = 4 * VIEW * FINER
    picture = np.full((side, side), 0.3, np.float32)
    small, large, power = 1.5, side / 6, 1 - steepness
    for size in ((large**power - small**power) * rng.random(16_000) + small**power) ** (1 / power):
        y, x = rng.integers(0, side, 2).tolist()
        value = float(np.exp(rng.normal(-1.2, 0.5)))
        if rng.random() < 0.5:
            cv2.circle(picture, (x, y), max(1, int(size)), value, -1)
        else:
            box = (
                (float(x), float(y)),
                (float(2 * size), float(2 * size * rng.uniform(0.3, 1))),
                float(rng.uniform(0, 180)),
            )
            cv2.fillPoly(picture, [cv2.boxPoints(box).astype(np.int32)], value)
    return picture


def _terrain(rng: np.random.Generator, slope: float) -> NDArray[np.float32]:
    """Ground without edges: a power spectrum of f^-slope, from stones (1.5) to bare fields (3)."""
    side = 2 * VIEW * FINER
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    frequency[0, 0] = np.inf
    picture = np.fft.irfft2(np.fft.rfft2(rng.normal(0, 1, (side, side))) * frequency ** (-slope / 2), s=(side, side))
    return np.asarray(0.3 * np.exp(0.4 * picture / picture.std()), dtype=np.float32)


def _photograph(rng: np.random.Generator, ground: NDArray[np.float32], diameter_px: float) -> Grey:
    """A slice (VIEW, VIEW) of some of the ground, out of focus by a disc, with up to 0.4 pixels of motion and noise."""
    side = VIEW * FINER
    top, left = rng.integers(0, ground.shape[0] - side, 2)
    part = np.rot90(ground[top : top + side, left : left + side], int(rng.integers(4))).astype(np.float64)
    fy, fx = np.fft.fftfreq(side)[:, None] * FINER, np.fft.rfftfreq(side)[None, :] * FINER
    x = np.maximum(np.pi * diameter_px * np.hypot(fy, fx), 1e-9)
    along, angle = rng.uniform(0, 0.4), rng.uniform(0, math.pi)
    transfer = 2 * j1(x) / x * np.sinc(along * (fx * math.cos(angle) + fy * math.sin(angle)))
    spectrum = np.fft.rfft2(part) * transfer
    half = VIEW // 2
    band = np.concatenate([spectrum[:half, : half + 1], spectrum[-half:, : half + 1]]) / FINER**2
    band[half] = band[:, half] = 0
    return np.asarray(np.fft.irfft2(band, s=(VIEW, VIEW)))


def clipping(frames: int, seed: int) -> Iterator[tuple[float, float]]:
    """(true, measured) shares of white pixels."""
    rng = np.random.default_rng(seed + 2000)
    more: dict[str, Any] = {"black": 128, "white": 4095, "cfa": None, "colour_names": (), "balance": None}
    for _ in range(frames):
        smooth = cv2.GaussianBlur(rng.normal(0, 1, (240, 320)).astype(np.float32), (0, 0), float(rng.uniform(1, 6)))
        values = np.clip(1500 + 600 * smooth / smooth.std(), 0, 3900)
        values[smooth >= np.quantile(smooth, 1 - rng.uniform(0, 0.1))] = 4095
        raw = RawFile.of(ExposureSettings(), values.astype(np.uint16), **more)
        yield float(np.mean(values >= 4095)), exposure(raw).clipped_share


if __name__ == "__main__":
    main()
