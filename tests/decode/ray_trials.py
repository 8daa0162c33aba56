"""Calibrate frames by rays (`ray_frames`), and judge what comes out against the truth; for tests and benchmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import MaskDecoder
from dappled.decode.errors import DecodeError
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Mask, Sensor
from tests.decode import rays
from tests.decode.ray_frames import CANON, FUJI, MASKS, Body, Film, Order, Shot, Stop

SMALL = Body((357, 536), CANON.pitch_mm, "450D, an eighth of its sides")
LENGTHS_MM = {CANON: (85.0, 28.0), FUJI: (13.0, 20.0)}
F_NUMBERS = (8.0, 11.0, 16.0, 22.0, 32.0)
ENOUGH = 2  # orders above noise in half of the plane: 4 in the whole plane
STATED_MM = 1.01


def mask_of(film: Film) -> Mask:
    """The mask as its profile has it: the design, not the print."""
    return Mask(film.frequency_per_mm, film.p, film.pattern, film.harmonics, film.px_per_mm)


def sensor_of(body: Body) -> Sensor:
    return Sensor(body.shape, (body.pitch_mm[0], 0.0), (0.0, body.pitch_mm[1]))


def calibrated(shot: Shot, law: str = "fd", film: Film | None = None) -> Calibration:
    """`film` is what is believed to be before the sensor (None: what is)."""
    frame = CalibrationFrame(shot.frame(), shot.focal_length_mm, shot.f_number)
    return calibrate(
        [frame],
        MaskedOptics(sensor_of(shot.body), mask_of(film or shot.film), law, STATED_MM),
        choose_law=True,
    )


def attempt(shot: Shot) -> tuple[Calibration | None, str]:
    """The calibration, or the sentence of its refusal."""
    try:
        return calibrated(shot), ""
    except DecodeError as refused:
        return None, str(refused)


def off_bins(shot: Shot, found: Calibration, orders: list[Order] | None = None) -> float:
    """Rms over all of the mask's orders on the sensor, seen or not, or over these."""
    k = np.array(orders or list(shot.seen()))
    off = k @ (found.fits[0].lattice.matrix() - shot.lattice) * shot.body.shape
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def reach(shot: Shot, above: list[Order]) -> float:
    """How much farther out the mask's orders on the sensor lie than those that can be seen: so far errors grow."""
    farthest = [max(float(np.hypot(*order)) for order in orders) for orders in (shot.seen(), above)]
    return farthest[0] / farthest[1]


def seeded(seed: int) -> Shot:
    """A shot of any mask, stop, turn, focal length and textured scene on an eighth of a 450D's sides."""
    names = list(MASKS)
    rng = np.random.default_rng(seed)
    return Shot(
        MASKS[names[seed % len(names)]],
        SMALL,
        f_number=float(rng.choice(list(F_NUMBERS))),
        focal_length_mm=float(rng.choice([20.0, 35.0, 50.0])),
        turn_deg=float(rng.uniform(-2, 2)),
        stop=Stop(str(rng.choice(["round", "square", "polygon"]))),  # type: ignore[arg-type]  # one of its shapes
        scene=str(rng.choice(["texture", "boards"])),  # type: ignore[arg-type]  # likewise
        exponent=float(rng.uniform(1.1, 2.0)),
        seed=seed,
    )


def bare(shot: Shot) -> CalibrationFrame:
    """The same shot without a film."""
    return CalibrationFrame(shot.without_film(), shot.focal_length_mm, shot.f_number)


def photograph(number: int) -> CalibrationFrame:
    """An ordinary photograph without a film: overlapping edges, a printed page, or a power law, one after another."""
    rng = np.random.default_rng([number, 30])
    scene = (_edges, _text, _power_law)[number % 3](rng)
    return noisy(scene, rng)


def noisy(scene: NDArray[np.float64], rng: np.random.Generator) -> CalibrationFrame:
    """A frame of a scene at SNR 100, its focal length and f-number drawn."""
    plane = scene * 0.35 / scene.mean()
    plane = np.clip(plane + rng.normal(size=plane.shape) * np.sqrt(np.maximum(plane, 0) * 0.35) / 100, 0, 1)
    return CalibrationFrame(plane.astype(np.float32), float(rng.choice([20.0, 50.0])), float(rng.choice([8, 22])))


def shows_no_carriers(frame: CalibrationFrame, film: Film, body: Body = SMALL, law: str = "geometric") -> bool:
    """Whether a frame without a film is refused as such; False where a lattice was found in it."""
    try:
        calibrate([frame], MaskedOptics(sensor_of(body), mask_of(film), law, STATED_MM))
    except DecodeError as refused:
        return "no carriers" in str(refused)
    return False


def print_costs_db(scale: float, seed: int, beams: int, snr: float = 100.0) -> tuple[float, float]:
    """PSNR of views, in dB, of a frame at full aperture whose mask was printed at a scale: told the design, and told
    the print. `beams` along each side of the stop, 5 n for n × n rays a view; two textures at two depths.
    """
    rng = np.random.default_rng([seed, 18])
    hidden = replace(rays.Camera.hidden(seed), beams=beams)
    camera = replace(hidden, mask=replace(rays.MASK, frequency_per_mm=scale * rays.MASK.frequency_per_mm))
    scene = [(rays.Texture.random(rng, mean=0.2, rms=0.08), shift) for shift in (3.0, -1.0)]
    white = camera.expose([(rays.Texture.random(rng), 1.0)], rays.STOPPED_F)
    plane = camera.expose(scene)
    plane = (plane + rng.normal(size=plane.shape) * plane.mean() / snr).astype(np.float32)
    found = []
    for mask in (rays.MASK, camera.mask):
        known = calibrate(
            [CalibrationFrame(white, rays.FOCAL_MM, rays.STOPPED_F)],
            MaskedOptics(rays.SENSOR, mask, "geometric", rays.STATED_DISTANCE_MM),
        )
        decoder = MaskDecoder(MaskedOptics(rays.SENSOR, mask, "geometric", rays.STATED_DISTANCE_MM), known)
        field = decoder.decode(plane, focal_length_mm=rays.FOCAL_MM, f_number=rays.FULL_F)
        truth = camera.truth(scene, field.grid, (field.views.shape[2], field.views.shape[3]))
        found.append(rays.psnr(field.views, truth))
    return found[0], found[1]


def _edges(rng: np.random.Generator) -> NDArray[np.float64]:
    """Roofs: half planes of all directions over each other, with a sky."""
    y, x = np.mgrid[0 : SMALL.shape[0], 0 : SMALL.shape[1]]
    picture = 0.7 + 0.1 * y / y.max()
    for angle, place, level in zip(
        rng.uniform(0, np.pi, 25), rng.uniform(-0.2, 1.2, 25), rng.uniform(0.1, 1, 25), strict=True
    ):
        inside = np.cos(angle) * x + np.sin(angle) * y < place * np.hypot(*SMALL.shape)
        picture = np.where(inside & (y > rng.uniform(0, 300)), level, picture)
    return np.asarray(picture)


def _text(rng: np.random.Generator) -> NDArray[np.float64]:
    """A printed page, turned a little: lines at one distance, words at none."""
    page = Image.new("L", (900, 900), 230)
    pen = ImageDraw.Draw(page)
    size = int(rng.integers(9, 17))
    for line in range(0, 900, round(1.6 * size)):
        words = " ".join("".join(map(chr, rng.integers(97, 123, rng.integers(2, 10)))) for _ in range(25))
        pen.text((20, line), words, fill=25, font=ImageFont.load_default(size))
    turned = page.rotate(float(rng.uniform(-8, 8)), Image.Resampling.BICUBIC, fillcolor=230)
    high, wide = SMALL.shape
    return np.asarray(turned, dtype=np.float64)[200 : 200 + high, 180 : 180 + wide] / 255


def _power_law(rng: np.random.Generator) -> NDArray[np.float64]:
    exponent, seed = float(rng.uniform(0.9, 2.0)), int(rng.integers(10000))
    shot = Shot(MASKS["mask-2"], SMALL, scene="texture", exponent=exponent, seed=seed, finer=1)
    return shot.without_film().astype(np.float64)
