"""Maps, convergence and geoid, against finite differences, published values and places where signs go wrong."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.products.maps import earth
from dappled.products.maps.earth import EarthError, Geoid, Projection, geoid, utm, wrapped

PLACES = {
    "equator": (0.001, 10.0),
    "60° north, far from the zone's middle": (60.0, 24.05),
    "southern hemisphere": (-33.9, 18.4),
    "just west of the antimeridian": (-17.0, 179.9999),
    "just east of the antimeridian": (-17.0, -179.9999),
    "near the north pole": (88.0, 30.0),
    "near the south pole": (-85.0, -100.0),
}
EGM96 = Path("/usr/share/proj/egm96_15.gtx")


@pytest.mark.parametrize("name", PLACES)
def test_true_north_and_scale_are_what_small_steps_on_the_map_show(name: str) -> None:
    latitude, longitude = PLACES[name]
    projection = Projection(utm(latitude, longitude))
    at = projection.at(latitude, longitude)
    step = 1e-5
    here = np.array(projection.to_map(latitude, longitude))
    north = np.array(projection.to_map(latitude + step, longitude)) - here
    turned = at.from_ned()
    assert turned[:2, 0] == pytest.approx(north / np.linalg.norm(north), abs=2e-6)
    assert turned @ turned.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1.0)
    geod = pyproj.Geod(ellps="WGS84")
    metres = geod.inv(longitude, latitude, longitude, latitude + step)[2]
    assert np.linalg.norm(north) / metres == pytest.approx(at.scale, rel=2e-5)


def test_convergence_at_60_north_is_as_large_as_it_should_be() -> None:
    """tan γ = tan Δλ · sin φ for the transverse Mercator, to 1e-4 on the ellipsoid."""
    at = Projection("EPSG:32635").at(60.0, 24.05)
    expected = math.atan(math.tan(math.radians(24.05 - 27.0)) * math.sin(math.radians(60.0)))
    assert at.convergence_rad == pytest.approx(expected, abs=1e-4)
    assert math.degrees(at.convergence_rad) == pytest.approx(-2.56, abs=0.01)


@given(st.floats(-79.9, 83.9), st.floats(-180, 179.999))
def test_there_and_back(latitude: float, longitude: float) -> None:
    east, north = PROJECTIONS.setdefault(utm(latitude, longitude), Projection(utm(latitude, longitude))).to_map(
        latitude, longitude
    )
    back = PROJECTIONS[utm(latitude, longitude)].to_geodetic(east, north)
    assert float(back[0]) == pytest.approx(latitude, abs=1e-9)
    assert math.remainder(float(back[1]) - longitude, 360) == pytest.approx(0, abs=1e-8)


PROJECTIONS: dict[str, Projection] = {}


def test_the_zone_of_a_place() -> None:
    assert utm(41.6, -91.5) == "EPSG:32615"
    assert utm(0.0, 180.0) == "EPSG:32601"
    assert utm(0.0, 179.9999) == "EPSG:32660"
    assert utm(-80.5, 0.0) == "EPSG:32761"
    assert wrapped(540.0) == -180.0


@pytest.mark.parametrize(
    ("crs", "place", "said"),
    [
        ("EPSG:4326", (41, -91), "not a map projection in metres"),
        ("EPSG:2263", (41, -74), "US survey foot"),
        ("nonsense", (41, -91), "not a coordinate system"),
        ("EPSG:32633", (41, -91), "does not cover"),
        ("EPSG:32615", (-41, -91), "does not cover"),
    ],
)
def test_a_wrong_system_is_said_in_a_sentence(crs: str, place: tuple[float, float], said: str) -> None:
    with pytest.raises(EarthError, match=said):
        Projection(crs).at(*place)


def test_a_neighbouring_zone_is_a_map_too() -> None:
    assert Projection("EPSG:32660").at(0.0, -179.9).east > 800_000


@pytest.mark.skipif(not EGM96.is_file(), reason="Debian's proj-data is not installed")
@pytest.mark.parametrize(
    ("latitude", "longitude", "expected_m"),
    [
        # NGA's own test values of EGM96 (15', bilinear there and here to some centimetres)
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ],
)
def test_the_geoid_is_where_its_makers_say(latitude: float, longitude: float, expected_m: float) -> None:
    assert geoid(None).undulation_m(latitude, longitude) == pytest.approx(expected_m, abs=0.15)


def test_a_constant_geoid_and_a_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert geoid("-31.5").undulation_m(10, 10) == -31.5
    assert geoid("-31.5").name == "constant -31.5 m"
    for metres in ("nan", "inf", "1e400", "-121"):
        with pytest.raises(EarthError, match=f"nowhere {metres} m above"):
            geoid(metres)
    with pytest.raises(EarthError, match=r"no geoid grid .*nowhere\.gtx"):
        geoid(str(tmp_path / "nowhere.gtx"))
    (tmp_path / "broken.gtx").write_bytes(b"no grid")
    with pytest.raises(EarthError, match=r"broken\.gtx can't be read"):
        Geoid(grid=tmp_path / "broken.gtx").undulation_m(10, 10)
    monkeypatch.setattr(earth, "_GEOID_GRIDS", ("egm_of_nobody.gtx",))
    with pytest.raises(EarthError, match=r"egm_of_nobody\.gtx.*proj-data.*--geoid"):
        geoid(None)


@pytest.mark.skipif(not EGM96.is_file(), reason="Debian's proj-data is not installed")
def test_the_geoid_is_smooth_across_the_antimeridian() -> None:
    west, east = (geoid(None).undulation_m(-17.0, longitude) for longitude in (179.999, -179.999))
    assert west == pytest.approx(east, abs=0.02)
    assert geoid(None).undulation_m(-17.0, 180.0) == pytest.approx(west, abs=0.02)
