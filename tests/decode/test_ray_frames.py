"""The yardstick against closed forms: sinc², jinc with their nulls and signs, places of carriers, single rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from tests.decode.ray_frames import CANON, FUJI, MASKS, Body, Film, Shot, Stop, line_strength

SMALL = Body((90, 120), CANON.pitch_mm, "a few periods")


def _jinc(cycles: float) -> float:
    turns = np.pi * cycles
    return float(2 * special.j1(turns) / turns)


@pytest.mark.parametrize("cycles", [0.2, 0.7, 1.219, 1.6, 2.233])  # 1.22 and 2.23 are nulls of the round stop
def test_stops_average_as_their_closed_forms(cycles: float) -> None:
    along, diagonal = np.array([[cycles, 0.0]]), np.array([[cycles, cycles]]) / np.sqrt(2)
    for direction in (along, diagonal):
        assert Stop("round").average(direction)[0] == pytest.approx(_jinc(cycles), abs=2e-3)
    assert Stop("square").average(along)[0] == pytest.approx(np.sinc(cycles), abs=2e-3)
    assert Stop("square").average(diagonal)[0] == pytest.approx(np.sinc(cycles / np.sqrt(2)) ** 2, abs=2e-3)
    many, few = Stop("polygon", blades=48), Stop("polygon", blades=5)
    assert many.average(along)[0] == pytest.approx(_jinc(cycles), abs=1e-2)
    assert few.average(along)[0].imag != pytest.approx(0, abs=1e-3) or cycles < 0.5  # no symmetry about the centre


def test_a_round_stop_turns_an_order_over_between_its_nulls() -> None:
    stop = Stop("round")
    signs = [stop.average(np.array([[c, 0.0]]))[0].real for c in (0.6, 1.22, 1.7, 2.233, 2.7)]
    assert signs[0] > 0.4
    assert signs[2] < -0.1
    assert signs[4] > 0.03
    assert abs(signs[1]) < 2e-3 > abs(signs[3])


@pytest.mark.parametrize(
    ("name", "stop"), [("mask-2-full", Stop("round", n=10)), ("mask-2", Stop("square", n=10))], ids=["round", "square"]
)
def test_plane_waves_are_what_single_rays_sum_to(name: str, stop: Stop) -> None:
    shot = Shot(MASKS[name], SMALL, f_number=14.0, turn_deg=1.5, stop=stop, diffraction=False)
    rays = shot.by_rays()
    for order in shot.orders:
        fy, fx = (np.array(order) @ shot.lattice).tolist()
        (whole,) = shot.strengths([order])
        (on_film,) = shot.film_per_mm([order])
        loss = np.sinc(on_film / shot.film.px_per_mm).prod()
        pixel = np.sinc([fy, fx]).prod() / np.sinc(np.array([fy, fx]) / shot.finer).prod()
        assert line_strength(rays, fy, fx) == pytest.approx(whole / loss * pixel, abs=2e-3)


@pytest.mark.parametrize("body", [CANON, FUJI], ids=["450D", "S5200"])
def test_carriers_stand_where_similar_triangles_put_them(body: Body) -> None:
    shot = Shot(Film(11.38, 2), body, focal_length_mm=25.0, f_number=40.0, snr=1e6)
    bins = shot.lattice * body.shape
    sides_mm = np.array(body.shape) * body.pitch_mm
    assert np.diag(bins) == pytest.approx(11.38 * (1 - 1.01 / 25) * sides_mm)
    plane = shot.frame()
    fy, fx = (np.array((1, -1)) @ shot.lattice).tolist()
    peak = abs(line_strength(plane, fy, fx))
    assert peak == pytest.approx(shot.seen()[1, -1], rel=0.02)
    for step in (1.0, -1.0):
        assert abs(line_strength(plane, fy + step / body.shape[0], fx)) < 0.65 * peak


def test_the_numbers_of_the_physics_page_come_out() -> None:
    """Mask 2 on a 450D at 50 mm, geometry alone: at f/92 all orders, at f/22 little of the second harmonic."""
    film = MASKS["mask-2"]
    whole = film.amplitudes[1, 1]
    at = {n: Shot(film, f_number=n, diffraction=False).seen() for n in (92.0, 32.0, 22.0, 8.0)}
    assert at[92.0][1, 1] / whole > 0.8
    assert at[92.0][2, 2] / whole > 0.5
    assert Shot(film, f_number=92.0).seen()[2, 2] < 0.4 * at[92.0][2, 2]  # and diffraction takes most of that
    assert at[32.0][2, 2] < 0.22 * at[32.0][1, 1]
    assert at[22.0][2, 2] < 0.25 * at[22.0][1, 1]
    assert at[8.0][1, 1] < 0.1 * whole
    sensor_bins = np.diag(Shot(film, replace(CANON, shape=(2848, 4272))).lattice) * (2848, 4272)
    assert sensor_bins == pytest.approx([165.0, 247.5], abs=0.6)  # the page has 165/248


def test_mask_and_film_set_what_can_be_there() -> None:
    assert MASKS["mask-4-octave"].multiples == [1, 2, 4, 8]  # periods 20, 10, 5 and 2.5 px; the rest can't be drawn
    assert MASKS["mask-4-linear"].multiples == list(range(1, 11))
    assert len(MASKS["mask-2"].amplitudes) == 9
    assert len(MASKS["mask-2-full"].amplitudes) == 25
    sizes = {abs(v) for order, v in MASKS["mask-2"].amplitudes.items() if order != (0, 0)}
    assert max(sizes) == pytest.approx(0.25 / 1.125, rel=5e-3)  # the lowest value of cos·cos + cos·cos is −9/8


def test_printing_at_another_scale_and_turning_are_where_they_should_be() -> None:
    shot = Shot(replace(MASKS["mask-2"], scale=1.01, anisotropy=0.004), turn_deg=2.0)
    a, b = shot.lattice / CANON.pitch_mm
    assert np.hypot(*a) / np.hypot(*b) == pytest.approx(1.004, rel=1e-4)
    assert np.hypot(*a) == pytest.approx(11.38 * 1.01 * 1.002 * (1 - 1.01 / 50), rel=1e-6)
    assert np.degrees(np.arctan2(a[1], a[0])) == pytest.approx(2.0)
