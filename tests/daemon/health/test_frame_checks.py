"""Go or no-go, on frames whose faults are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from dappled.daemon.health.frame_checks import check_frame, sharpness
from dappled.drivers.raw import reading
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Level, Subject, finding, told
from dappled.mocks.scene.masked_camera import reference_camera
from tests.cli.test_thesis_camera import PROFILE, QUARTER, dng_of
from tests.decode.ray_frames import MASKS, Shot

RECIPE = Recipe(camera="reference-36mm", mask="reference-5x5")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("frame") / "good.dng"
    path.write_bytes(reference_camera(1, scale=0.5).expose(10.0, 1, f_number=14.8).file)
    return path


def by_name(found: list[Finding]) -> dict[str, Finding]:
    return {one.subject.kind: one for one in found}


def test_a_good_frame_is_go(good: Path) -> None:
    found = by_name(check_frame(good, RECIPE))
    assert {one.level for one in found.values()} == {Level.NOTE}
    assert set(found) == {"focal length", "exposure", "carriers", "focus", "motion"}
    assert found["focal length"].facts["focal_length_mm"] == 50.0


def test_without_a_mask_configured_the_rest_is_looked_at(good: Path) -> None:
    found = by_name(check_frame(good, None))
    assert found["carriers"].level == Level.CAUTION
    assert found["exposure"].level == Level.NOTE


def test_a_clipped_frame_is_no_go(tmp_path: Path) -> None:
    path = tmp_path / "bright.dng"
    camera = reference_camera(1, scale=0.25)
    metered_s, _ = camera.metered(14.8)
    path.write_bytes(camera.expose(10.0, 1, f_number=14.8, exposure_s=8 * metered_s).file)
    found = by_name(check_frame(path, None))
    assert found["exposure"].level == Level.STOP
    assert "expose less" in str(told(found["exposure"]))


def refuse(*_: object, **__: object) -> None:
    raise DappledError("it is not looked at")


def test_a_jpeg_is_no_go_behind_a_mask(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "good.jpg"
    values = reading.read(good).mosaic
    Image.fromarray((255 * (values / values.max()) ** (1 / 2.2)).astype(np.uint8)).save(path, quality=95)
    assert by_name(check_frame(path, None))["tones"].level == Level.CAUTION
    monkeypatch.setattr(Darkroom, "decode", refuse)
    found = by_name(check_frame(path, RECIPE))["tones"]
    assert found.level == Level.STOP
    assert str(told(found)).startswith("it is a JPEG: its tones are not linear")


def test_what_a_calibration_is_in_doubt_about_is_a_caution(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decode = Darkroom.decode
    doubt = finding(Code.LAW_NEITHER, Subject("calibration"), fits="", stated_mm=1.0)
    monkeypatch.setattr(
        Darkroom, "decode", lambda *words, **names: replace(decode(*words, **names), calibration_doubts=(doubt,))
    )
    found = by_name(check_frame(good, RECIPE))
    assert found["calibration"] == doubt


def test_a_frame_without_light_is_no_go(tmp_path: Path) -> None:
    path = tmp_path / "dark.dng"
    camera = reference_camera(1, scale=0.25)
    metered_s, _ = camera.metered(14.8)
    path.write_bytes(camera.expose(10.0, 1, f_number=14.8, exposure_s=metered_s / 50).file)
    assert "expose more" in str(told(by_name(check_frame(path, None))["exposure"]))


def test_the_wrong_mask_shows_no_carriers(good: Path) -> None:
    found = by_name(check_frame(good, Recipe(camera="reference-36mm", mask="mask-5")))
    assert found["carriers"].level == Level.STOP
    assert "mask" in str(told(found["carriers"]))


def test_a_mask_away_from_its_place_is_cautioned_of(tmp_path: Path) -> None:
    camera = reference_camera(1, scale=0.5)
    (tmp_path / "stopped.dng").write_bytes(camera.expose(10.0, 1, f_number=59.2).file)
    height, width = camera.sensor.shape
    (tmp_path / "off.toml").write_text(
        'law = "geometric"\nmask_distance_mm = 0.48\n[[raw]]\nname = "half"\n'
        f"shape = [{height}, {width}]\nrow_mm = [0.0092, 0.0]\ncolumn_mm = [0.0, 0.0092]\n"
    )
    found = by_name(
        check_frame(tmp_path / "stopped.dng", Recipe(camera=str(tmp_path / "off.toml"), mask="reference-5x5"))
    )
    assert found["carriers"].level == Level.CAUTION
    assert "farther out than predicted" in str(told(found["carriers"]))


def test_a_file_that_is_no_picture_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "x.dng"
    path.write_bytes(b"nothing")
    with pytest.raises(DappledError, match=r"x\.dng"):
        check_frame(path, None)


def ground(seed: int) -> NDArray[np.float64]:
    """A picture with edges of all directions at all sizes, as the ground has from the air."""
    rng = np.random.default_rng(seed)
    picture = np.full((240, 320), 0.5)
    rows, columns = np.mgrid[:240, :320]
    for _ in range(600):
        disc = np.hypot(rows - rng.uniform(0, 240), columns - rng.uniform(0, 320)) < rng.uniform(1.5, 30)
        picture[disc] = rng.uniform(0.2, 1.0)
    blurred: NDArray[np.float64] = ndimage.gaussian_filter(picture, 0.5)
    return blurred


@pytest.mark.parametrize("seed", range(2))
def test_focus_and_motion_are_told_apart(seed: int) -> None:
    sharp = ground(seed)
    assert [one.level for one in sharpness(sharp)] == [Level.NOTE, Level.NOTE]
    assert [one.level for one in sharpness(ndimage.gaussian_filter(sharp, 2.0))] == [Level.STOP, Level.CAUTION]
    for axis, word in ((1, "across"), (0, "along")):
        focus, motion = sharpness(ndimage.uniform_filter1d(sharp, 5, axis=axis))
        assert (focus.level, motion.level) == (Level.NOTE, Level.STOP)
        assert f"lost {word}" in str(told(motion))
    falling = np.diag(np.ones(5)) / 5
    focus, motion = sharpness(ndimage.convolve(sharp, falling))
    assert motion.level == Level.STOP
    assert "falling" in str(told(motion))


def test_carriers_by_another_law_or_none_to_be_seen_are_cautions(tmp_path: Path) -> None:
    (tmp_path / "quarter.toml").write_text(PROFILE)
    recipe = Recipe(str(tmp_path / "quarter.toml"), "mask-2", try_laws=True)
    stopped = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, turn_deg=1.0)
    opened = replace(stopped, f_number=1.8, scene="texture", exponent=1.1, snr=30.0)
    for shot, words in ((stopped, "seen by the law geometric, none where configured"), (opened, "none can be seen")):
        frame = dng_of(tmp_path / f"{shot.f_number}.dng", shot, shot.frame())
        one = by_name(check_frame(frame, recipe))["carriers"]
        assert one.level == Level.CAUTION
        assert words in str(told(one))
