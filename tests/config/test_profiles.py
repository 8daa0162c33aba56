"""Profiles: the shipped ones load, a person's own are validated, wrong names are answered."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.config import profiles
from dappled.config.schema import ConfigError
from dappled.decode.optics.carriers import LAWS


@pytest.mark.parametrize("name", profiles.shipped("cameras"))
def test_shipped_cameras_load(name: str) -> None:
    camera = profiles.camera(name)
    assert camera.law in LAWS
    for raw in camera.raw:
        assert camera.sensor(raw.sensor.shape) == raw.sensor


@pytest.mark.parametrize("name", profiles.shipped("masks"))
def test_shipped_masks_load(name: str) -> None:
    mask = profiles.mask(name).mask
    wanted = mask.views_per_axis**2 if mask.pattern == "full" else 4 * mask.p + 1
    assert len(mask.orders()) == wanted
    assert len(mask.half_orders()) == (wanted + 1) // 2


def test_the_contract_s_profiles_ship() -> None:
    assert {"fujifilm-s5200", "canon-eos-450d", "reference-36mm"} <= set(profiles.shipped("cameras"))
    assert {f"mask-{n}" for n in range(1, 6)} | {"mask-2-full", "reference-5x5", "mask-4-linear"} <= set(
        profiles.shipped("masks")
    )


def test_a_wrong_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean canon-eos-450d"):
        profiles.camera("canon-450d")


def test_a_frame_of_another_size_is_named() -> None:
    with pytest.raises(ConfigError, match=r"2776 × 3688.* px, this one is 100 × 200"):
        profiles.camera("fujifilm-s5200").sensor((100, 200))


@pytest.mark.parametrize("model", ["Canon EOS 450D", "CANON EOS 450d", "FinePix S5200", "FinePixS5500"])
def test_bodies_are_known_by_model(model: str) -> None:
    found = profiles.camera_for_model(model)
    assert found is not None
    assert found.name in ("canon-eos-450d", "fujifilm-s5200")


def test_unknown_model_is_unknown() -> None:
    assert profiles.camera_for_model("Leica M3") is None
    assert profiles.camera_for_model("") is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("p = 2", "needs frequency_per_mm, or period_px"),
        ("p = 0\nfrequency_per_mm = 10", "p = 0 must lie between 1 and 20"),
        ("p = 2\nfrequency_per_mm = -1.0", "must lie between"),
        ("p = 2\nfrequency_per_mm = 10\npatern = 'full'", "did you mean 'pattern'?"),
    ],
)
def test_masks_of_one_s_own_are_validated(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "my.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r".") as caught:
        profiles.mask(str(file))
    assert said in str(caught.value)


def test_a_camera_needs_a_raw_shape(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("law = 'fd'\nmask_distance_mm = 1.0")
    with pytest.raises(ConfigError, match=r"no \[\[raw\]\] table"):
        profiles.camera(str(file))


@pytest.mark.parametrize(
    ("name", "period", "p"), [("1", 5, 2), ("2", 10, 2), ("3", 10, 4), ("4", 20, 10), ("5", 20, 5)]
)
def test_masks_as_printed_are_table_3_s(name: str, period: float, p: int) -> None:
    known = profiles.mask(f"mask-{name}")
    assert (known.period_px, known.film_px_per_mm) == (period, 113.8)
    assert known.mask.frequency_per_mm == pytest.approx(113.8 / period)
    assert (known.mask.p, known.mask.pattern) == (p, "diagonal")


def test_the_s5200_s_native_lattice_covers_the_same_chip() -> None:
    camera = profiles.camera("fujifilm-s5200")
    picture, native = camera.sensor((2776, 3688)), camera.sensor((2948, 1856))
    assert picture.size_mm == pytest.approx((4.29, 5.76))
    assert native.row_mm == picture.row_mm
    assert native.column_mm[1] == pytest.approx(2 * picture.column_mm[1])
    assert camera.sensor((2918, 1852)).column_mm == native.column_mm


def test_a_mask_s_frequency_is_said_once(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("p = 2\nfrequency_per_mm = 10\nperiod_px = 10")
    with pytest.raises(ConfigError, match="leave one of them out"):
        profiles.mask(str(file))
