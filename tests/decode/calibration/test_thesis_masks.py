"""Masks 1 to 5 and the full Mask 2 on both bodies, ray by ray: where carriers stand, their lattice is found."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.errors import DecodeError
from dappled.decode.optics import MaskedOptics
from tests.decode.ray_frames import CANON, FUJI, MASKS, Body, Shot, Stop, orders_above_noise
from tests.decode.ray_trials import (
    ENOUGH,
    F_NUMBERS,
    LENGTHS_MM,
    SMALL,
    STATED_MM,
    attempt,
    bare,
    calibrated,
    mask_of,
    off_bins,
    photograph,
    reach,
    seeded,
    sensor_of,
    shows_no_carriers,
)


def _holds(shot: Shot) -> bool:
    """Whether a lattice was found; fails where it is wrong, or missing although enough orders stand."""
    found, words = attempt(shot)
    if found is None:
        assert len(orders_above_noise(shot)) < ENOUGH, words
        assert "seen in this frame" in words or "should stand out" in words
        return False
    above = orders_above_noise(shot)
    assert off_bins(shot, found) < (0.1 * reach(shot, above) if len(above) >= ENOUGH else 0.5)
    assert found.law == "geometric"
    return True


@pytest.mark.parametrize(
    ("name", "body", "f_number", "scene"),
    [
        ("mask-2", CANON, 22.0, "white"),
        pytest.param("mask-2", CANON, 32.0, "texture", marks=pytest.mark.slow),
        ("mask-1", CANON, 11.0, "white"),
        pytest.param("mask-3-octave", FUJI, 8.0, "texture", marks=pytest.mark.slow),
        pytest.param("mask-4-linear", FUJI, 16.0, "boards", marks=pytest.mark.slow),
        pytest.param("mask-2-full", CANON, 22.0, "boards", marks=pytest.mark.slow),
    ],
)
def test_a_mask_of_the_thesis_is_found_behind_a_round_stop(name: str, body: Body, f_number: float, scene: str) -> None:
    length = LENGTHS_MM[body][0]
    shot = Shot(MASKS[name], body, length, f_number, turn_deg=1.7, scene=scene, seed=3)  # type: ignore[arg-type]
    assert _holds(shot)


@pytest.mark.long
@pytest.mark.parametrize("name", MASKS)
@pytest.mark.parametrize("body", [CANON, FUJI], ids=["450D", "S5200"])
@pytest.mark.parametrize("scene", ["white", "texture", "boards"])
def test_every_cell_with_four_orders_above_noise_calibrates(name: str, body: Body, scene: str) -> None:
    stops = itertools.cycle([Stop("round"), Stop("square"), Stop("polygon"), Stop("polygon", blades=6)])
    turns = itertools.cycle([0.0, 2.0, -1.3, 0.4, -2.0])
    cells = list(enumerate(itertools.product(LENGTHS_MM[body], F_NUMBERS)))
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
    assert off_bins(shot, calibrated(shot, film=film)) < 0.1


def test_a_stop_that_averages_an_order_out_says_nothing_about_its_transfer() -> None:
    """f/22 leaves a fiftieth of the second harmonic, f/45 two thirds: the mean of both frames is that of f/45."""
    film = MASKS["mask-2"]

    def of(*f_numbers: float) -> list[float]:
        frames = [Shot(film, SMALL, 50.0, stop, turn_deg=0.7, scene="white", seed=2) for stop in f_numbers]
        shown = [CalibrationFrame(one.frame(), one.focal_length_mm, one.f_number) for one in frames]
        known = calibrate(shown, MaskedOptics(sensor_of(SMALL), mask_of(film), "geometric", STATED_MM))
        return [known.fits[0].transfer[place] for place in map(known.mask.half_orders().index, [(2, -2), (2, 2)])]

    assert of(22.0) == [0.0, 0.0]
    assert min(map(abs, of(45.0))) > 0.04
    assert of(22.0, 45.0) == pytest.approx(of(45.0), rel=1e-6)


def test_frames_as_the_fd_law_has_them_are_found_by_that_law() -> None:
    shot = Shot(MASKS["mask-2"], SMALL, f_number=40.0, focal_length_mm=40.0, turn_deg=1.0, law="fd")
    found = calibrated(shot, law="geometric")
    assert found.law == "fd"
    assert off_bins(shot, found) < 0.1


def test_what_cannot_be_seen_is_named_with_its_cause() -> None:
    film = replace(MASKS["mask-1"], frequency_per_mm=45.0)  # its second harmonic is finer than the film draws
    shot = Shot(film, SMALL, f_number=8.0, scene="texture")
    with pytest.raises(DecodeError, match=r"no carriers can be seen in this frame at f/8: \(1, -1\), \(1, 1\)") as told:
        calibrated(shot)
    assert "90 cycles/mm, which the film cannot draw" in str(told.value)
    assert "averaged out over the stop" in str(told.value)
    assert "small aperture" in str(told.value)


def test_a_frame_without_a_mask_is_refused_although_it_should_show_one() -> None:
    shot = Shot(MASKS["mask-2"], SMALL, f_number=22.0, scene="boards")
    assert shows_no_carriers(bare(shot), shot.film, law="fd")


@pytest.mark.long
@pytest.mark.parametrize("part", range(4))
def test_no_wrong_lattice_in_two_hundred_seeds(part: int) -> None:
    """Half of the frames have a film before the sensor, half none: nothing but the right lattice may come out."""
    for seed in range(50 * part, 50 * part + 50):
        shot = seeded(seed)
        if seed % 2:
            _holds(shot)
        else:
            assert shows_no_carriers(bare(shot), shot.film), seed


@pytest.mark.long
def test_no_carriers_in_thirty_ordinary_photographs() -> None:
    for number in range(30):
        frame = photograph(number)
        for name in ("mask-1", "mask-2", "mask-2-full", "mask-4-linear"):
            assert shows_no_carriers(frame, MASKS[name]), (number, name)


@pytest.mark.parametrize(("length", "f_number"), [(18.0, 11.0), (50.0, 12.0)])
def test_a_diagonal_mask_is_no_full_one_at_a_stop_that_may_hide_any_single_order(
    length: float, f_number: float
) -> None:
    """Round and square stops have their nulls at different f-numbers: no single order must be visible at f/11."""
    film = MASKS["mask-2"]
    shot = Shot(film, SMALL, length, f_number, stop=Stop("polygon", blades=6), turn_deg=1.8, finer=2)
    with pytest.raises(DecodeError, match=r"another mask"):
        calibrated(shot, film=replace(film, pattern="full"))
