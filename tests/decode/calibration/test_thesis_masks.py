"""Masks 1 to 5 and the full Mask 2 on both bodies, ray by ray: where carriers stand, their lattice is found."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Mask, Sensor
from tests.decode.ray_frames import CANON, FUJI, MASKS, Body, Film, Order, Shot, Stop, orders_above_noise

SMALL = Body((357, 536), CANON.pitch_mm, "450D, an eighth of its sides")
LENGTHS_MM = {CANON: (85.0, 28.0), FUJI: (13.0, 20.0)}
ENOUGH = 2  # orders above noise in half of the plane: 4 in the whole plane


def _mask(film: Film) -> Mask:
    return Mask(film.frequency_per_mm, film.p, film.pattern, film.harmonics, film.px_per_mm)


def _calibrated(shot: Shot, law: str = "fd", film: Film | None = None) -> Calibration:
    body = shot.body
    sensor = Sensor(body.shape, (body.pitch_mm[0], 0.0), (0.0, body.pitch_mm[1]))
    frame = CalibrationFrame(shot.frame(), shot.focal_length_mm, shot.f_number)
    return calibrate(
        [frame], sensor=sensor, mask=_mask(film or shot.film), law=law, mask_distance_mm=1.01, choose_law=True
    )


def _off_bins(shot: Shot, found: Calibration) -> float:
    """Rms over all of the mask's orders on the sensor, seen or not."""
    orders = np.array(list(shot.seen()))
    off = orders @ (found.fits[0].lattice.matrix() - shot.lattice) * shot.body.shape
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _reach(shot: Shot, above: list[Order]) -> float:
    """How much farther out the mask's orders on the sensor lie than those that can be seen: so far errors grow."""
    farthest = [max(float(np.hypot(*order)) for order in orders) for orders in (shot.seen(), above)]
    return farthest[0] / farthest[1]


def _attempt(shot: Shot) -> tuple[Calibration | None, str]:
    try:
        return _calibrated(shot), ""
    except DecodeError as refused:
        return None, str(refused)


def _holds(shot: Shot) -> bool:
    """Whether a lattice was found; fails where it is wrong, or missing although enough orders stand."""
    found, words = _attempt(shot)
    if found is None:
        assert len(orders_above_noise(shot)) < ENOUGH, words
        assert "seen in this frame" in words or "should stand out" in words
        return False
    above = orders_above_noise(shot)
    assert _off_bins(shot, found) < (0.1 * _reach(shot, above) if len(above) >= ENOUGH else 0.5)
    assert found.law == "geometric"
    return True


@pytest.mark.parametrize(
    ("name", "body", "f_number", "scene"),
    [
        ("mask-2", CANON, 22.0, "white"),
        ("mask-2", CANON, 32.0, "texture"),
        ("mask-1", CANON, 11.0, "white"),
        ("mask-3-octave", FUJI, 8.0, "texture"),
        ("mask-4-linear", FUJI, 16.0, "boards"),
        ("mask-2-full", CANON, 22.0, "boards"),
    ],
)
def test_a_mask_of_the_thesis_is_found_behind_a_round_stop(name: str, body: Body, f_number: float, scene: str) -> None:
    length = LENGTHS_MM[body][0]
    shot = Shot(MASKS[name], body, length, f_number, turn_deg=1.7, scene=scene, seed=3)  # type: ignore[arg-type]
    assert _holds(shot)


@pytest.mark.slow
@pytest.mark.parametrize("name", MASKS)
@pytest.mark.parametrize("body", [CANON, FUJI], ids=["450D", "S5200"])
@pytest.mark.parametrize("scene", ["white", "texture", "boards"])
def test_every_cell_with_four_orders_above_noise_calibrates(name: str, body: Body, scene: str) -> None:
    stops = itertools.cycle([Stop("round"), Stop("square"), Stop("polygon"), Stop("polygon", blades=6)])
    turns = itertools.cycle([0.0, 2.0, -1.3, 0.4, -2.0])
    cells = list(enumerate(itertools.product(LENGTHS_MM[body], (8.0, 11.0, 16.0, 22.0, 32.0))))
    for seed, (length, f_number) in cells[:: 1 if name == "mask-2" else 3]:
        _holds(
            Shot(
                MASKS[name],
                body,
                length,
                f_number,
                turn_deg=next(turns),
                stop=next(stops),
                scene=scene,  # type: ignore[arg-type]  # parametrized
                exponent=(1.1, 1.5, 2.0)[seed % 3],
                seed=seed,
                diffraction=seed % 2 == 0,
            )
        )


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_a_print_at_another_scale_is_found_with_its_anisotropy(scale: float) -> None:
    film = MASKS["mask-2"]
    shot = Shot(replace(film, scale=scale, anisotropy=0.01), SMALL, f_number=22.0, turn_deg=-1.0)
    assert _off_bins(shot, _calibrated(shot, film=film)) < 0.1


def test_frames_as_the_fd_law_has_them_are_found_by_that_law() -> None:
    shot = Shot(MASKS["mask-2"], SMALL, f_number=40.0, focal_length_mm=40.0, turn_deg=1.0, law="fd")
    found = _calibrated(shot, law="geometric")
    assert found.law == "fd"
    assert _off_bins(shot, found) < 0.1


def test_what_cannot_be_seen_is_named_with_its_cause() -> None:
    film = replace(MASKS["mask-1"], frequency_per_mm=45.0)  # its second harmonic is finer than the film draws
    shot = Shot(film, SMALL, f_number=8.0, scene="texture")
    with pytest.raises(DecodeError, match=r"no carriers can be seen in this frame at f/8: \(1, -1\), \(1, 1\)") as told:
        _calibrated(shot)
    assert "90 cycles/mm, which the film cannot draw" in str(told.value)
    assert "averaged out over the stop" in str(told.value)
    assert "small aperture" in str(told.value)


def test_a_frame_without_a_mask_is_refused_although_it_should_show_one() -> None:
    shot = Shot(MASKS["mask-2"], SMALL, f_number=22.0, scene="boards")
    bare = CalibrationFrame(shot.without_film(), 50.0, 22.0)
    sensor = Sensor(SMALL.shape, (SMALL.pitch_mm[0], 0.0), (0.0, SMALL.pitch_mm[1]))
    with pytest.raises(DecodeError, match="no carriers"):
        calibrate([bare], sensor=sensor, mask=_mask(shot.film), law="fd", mask_distance_mm=1.01)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_no_wrong_lattice_in_two_hundred_seeds(part: int) -> None:
    """Half of the frames have a film before the sensor, half none: nothing but the right lattice may come out."""
    names = list(MASKS)
    for seed in range(50 * part, 50 * part + 50):
        rng = np.random.default_rng(seed)
        shot = Shot(
            MASKS[names[seed % len(names)]],
            SMALL,
            f_number=float(rng.choice([8.0, 11.0, 16.0, 22.0, 32.0])),
            focal_length_mm=float(rng.choice([20.0, 35.0, 50.0])),
            turn_deg=float(rng.uniform(-2, 2)),
            stop=Stop(str(rng.choice(["round", "square", "polygon"]))),  # type: ignore[arg-type]  # one of its shapes
            scene=str(rng.choice(["texture", "boards"])),  # type: ignore[arg-type]  # likewise
            exponent=float(rng.uniform(1.1, 2.0)),
            seed=seed,
        )
        if seed % 2:
            _holds(shot)
            continue
        sensor = Sensor(SMALL.shape, (SMALL.pitch_mm[0], 0.0), (0.0, SMALL.pitch_mm[1]))
        frame = CalibrationFrame(shot.without_film(), shot.focal_length_mm, shot.f_number)
        with pytest.raises(DecodeError, match="no carriers"):
            calibrate([frame], sensor=sensor, mask=_mask(shot.film), law="geometric", mask_distance_mm=1.01)


def _edges(rng: np.random.Generator) -> np.ndarray:
    """Roofs: half planes of all directions over each other, with a sky."""
    y, x = np.mgrid[0 : SMALL.shape[0], 0 : SMALL.shape[1]]
    picture = 0.7 + 0.1 * y / y.max()
    for angle, place, level in zip(
        rng.uniform(0, np.pi, 25), rng.uniform(-0.2, 1.2, 25), rng.uniform(0.1, 1, 25), strict=True
    ):
        inside = np.cos(angle) * x + np.sin(angle) * y < place * np.hypot(*SMALL.shape)
        picture = np.where(inside & (y > rng.uniform(0, 300)), level, picture)
    return np.asarray(picture)


def _text(rng: np.random.Generator) -> np.ndarray:
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


def _power_law(rng: np.random.Generator) -> np.ndarray:
    exponent, seed = float(rng.uniform(0.9, 2.0)), int(rng.integers(10000))
    shot = Shot(MASKS["mask-2"], SMALL, scene="texture", exponent=exponent, seed=seed, finer=1)
    return shot.without_film().astype(np.float64)


@pytest.mark.slow
def test_no_carriers_in_thirty_ordinary_photographs() -> None:
    sensor = Sensor(SMALL.shape, (SMALL.pitch_mm[0], 0.0), (0.0, SMALL.pitch_mm[1]))
    for number in range(30):
        rng = np.random.default_rng([number, 30])
        scene = (_edges, _text, _power_law)[number % 3](rng)
        plane = scene * 0.35 / scene.mean()
        plane = np.clip(plane + rng.normal(size=plane.shape) * np.sqrt(np.maximum(plane, 0) * 0.35) / 100, 0, 1)
        frame = CalibrationFrame(plane.astype(np.float32), float(rng.choice([20.0, 50.0])), float(rng.choice([8, 22])))
        for name in ("mask-1", "mask-2", "mask-2-full", "mask-4-linear"):
            with pytest.raises(DecodeError, match="no carriers"):
                calibrate([frame], sensor=sensor, mask=_mask(MASKS[name]), law="geometric", mask_distance_mm=1.01)
