from __future__ import annotations

import base64
import ctypes
import io
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image

import dappled
from dappled import codec
from dappled.decode.depth.ranging import Ranging
from dappled.decode.errors import DecodeError
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, finding
from dappled.mocks.scene.masked_camera import reference_camera
from dappled.products import opened
from dappled.products.exports import light_files
from dappled.products.opened import OpenedFrame, OpenedLightField, OpenError
from tests.needs import without
from tests.products.fields import DISPARITY, light_field

CLIPPED = codec.plain(finding(Code.FRAME_CLIPPED, FRAME, share=0.03))
DEVELOPED = codec.plain(finding(Code.FRAME_DEVELOPED, FRAME, why="a <JPEG>"))


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(matplotlib.rcParams, "backend", "agg")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    light_files.save(tmp_path / "a.npz", light_field())
    return tmp_path / "a.npz"


def test_a_light_field_is_opened_refocused_and_measured(path: Path) -> None:
    found = dappled.open(path)
    assert isinstance(found, OpenedLightField)
    assert found.views.shape == (5, 5, 60, 80)
    assert found.slices.shape == (3, 60, 80)
    assert found.attributes["camera"] == "reference-36mm"
    middle = found.views[2, 2]
    inner = (slice(6, -6), slice(6, -6))
    sharp, as_taken = found.refocus(disparity=DISPARITY), found.refocus()
    assert np.abs(sharp - middle)[inner].max() < np.abs(as_taken - middle)[inner].max() / 3
    # 5 views of 0.1 mm pixels: 0.2 mm over an aperture of 6.757 mm, which is 1 − 1/α (Eq 28).
    np.testing.assert_allclose(found.refocus(alpha=1 / (1 - 0.2 * 7.4 / 50)), sharp, atol=1e-5)
    np.testing.assert_allclose(found.refocus(disparity=DISPARITY, aperture=0.1), middle, atol=1e-6)
    depth = found.depth()
    assert np.nanmedian(depth.disparity) == pytest.approx(DISPARITY, abs=0.01)
    assert found.eyes().left.shape == (60, 80)


def test_blas_has_one_thread_while_the_face_computes(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = sorted((Path(np.__file__).parents[1] / "numpy.libs").glob("*openblas*"))
    library = ctypes.CDLL(str(found[0])) if found else None
    if not hasattr(library, "scipy_openblas_get_num_threads64_"):
        without("NumPy has no OpenBLAS of its own here")
    assert library is not None
    threads, put = library.scipy_openblas_get_num_threads64_, library.scipy_openblas_set_num_threads64_
    before, inside = threads(), list[int]()

    def seen(*_: object, **__: object) -> None:
        inside.append(threads())
        raise DecodeError("seen")

    monkeypatch.setattr("dappled.products.opened.Darkroom.decode", seen)
    monkeypatch.setattr("dappled.products.opened.depths.estimate", seen)
    frame = tmp_path / "frame.npy"
    np.save(frame, np.zeros((64, 64), np.float32))
    put(3)
    try:
        for ask in (
            lambda: dappled.open(frame, kind="frame", mask="reference-5x5", camera="reference-36mm").views,
            lambda: dappled.open(path, kind="light field").depth(),
        ):
            with pytest.raises(DecodeError, match="seen"):
                ask()
            assert threads() == 3
    finally:
        put(before)
    assert inside == [1, 1]


def test_metres_need_a_calibration_or_a_focus(path: Path) -> None:
    found = opened.light_field(path)
    assert found.ranging is None
    with pytest.raises(OpenError, match="has no distances"):
        found.refocus(distance_m=5.0)
    focused = opened.light_field(path, focus_m=float("inf"))
    assert focused.ranging is not None
    # One view's step is a fifth of 6.757 mm, a pixel of a view 0.1 mm: Eq 5.
    distance = 50.0 / 7.4 / 5 * 50e-3 / (DISPARITY * 0.1)
    assert focused.disparity_of(distance_m=distance) == pytest.approx(DISPARITY, rel=1e-6)
    made = focused.distances(focused.depth())
    assert np.nanmedian(made.distance_m) == pytest.approx(distance, rel=0.03)
    nearest = made.nearest()
    assert nearest is not None
    assert nearest[0] == pytest.approx(distance, rel=0.1)
    assert 0 < nearest[1] < 0.2 * distance


def test_a_kept_ranging_follows_the_f_number() -> None:
    lens = Ranging(40.0, -1.0, f_number=7.4, focal_length_mm=50.0)
    found = OpenedLightField(opened.with_ranging(light_field(f_number=14.8), lens))
    assert found.ranging is not None
    assert found.ranging.gain_px_m == pytest.approx(20.0)


def test_a_ranging_of_another_zoom_gives_no_metres() -> None:
    """It would be wrong by the square of the ratio."""
    lens = Ranging(40.0, -1.0, f_number=7.4, focal_length_mm=12.8)
    field = opened.with_ranging(light_field(), lens)
    assert OpenedLightField(field).ranging is None
    with pytest.raises(DecodeError, match=r"calibrated at a focal length of 12\.8 mm, the frame's is 50 mm"):
        OpenedLightField(field).refocus(distance_m=5.0)
    by_focus = OpenedLightField(field, focus_m=float("inf")).metres()
    assert by_focus.focal_length_mm == 50.0


@pytest.mark.parametrize("change", [{"camera": "nobody's"}, {"f_number": None}, {"lenslet_pitch_px": [10, 10]}])
def test_a_camera_that_is_not_known_has_relative_depth_only(change: dict[str, Any]) -> None:
    assert opened.lens_ranging(light_field(**change), float("inf")) is None


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_a_folder_of_pictures_is_a_light_field(tmp_path: Path, ending: str) -> None:
    field = light_field(n=3)
    for v in range(3):
        for u in range(3):  # cameras: further right, near things are further left
            picture = np.rint(65535 * field.views[2 - v, 2 - u]).astype(np.uint16)
            Image.fromarray(picture if ending == "tif" else (picture >> 8).astype(np.uint8)).save(
                tmp_path / f"v{v}_{u}.{ending}"
            )
    found = dappled.open(tmp_path)
    assert isinstance(found, OpenedLightField)
    assert found.slices.shape[0] == 0
    assert np.nanmedian(found.depth().disparity) == pytest.approx(DISPARITY, abs=0.02)
    with pytest.raises(DappledError, match="has no distances"):
        found.metres()


def test_what_cannot_be_opened_is_told(tmp_path: Path, path: Path) -> None:
    (tmp_path / "frame.cr2").write_bytes(b"raw")
    (tmp_path / "empty").mkdir()
    for act, words in (
        (lambda: dappled.open(tmp_path / "gone"), "does not exist"),
        (lambda: dappled.open(tmp_path / "frame.cr2"), "say how to decode it"),
        (lambda: dappled.open(tmp_path / "frame.cr2", mesh="mask-2"), "can't be opened with these arguments"),
        (lambda: dappled.open(path, mask="nonsense"), "is decoded already: leave mask out"),
        (lambda: dappled.open(tmp_path / "empty"), "holds 0 pictures"),
        (lambda: opened.light_field(path).refocus(alpha=1, disparity=2), "give one of"),
        (lambda: OpenedLightField(light_field(f_number=None)).refocus(alpha=1), "how wide its lens is"),
    ):
        with pytest.raises(OpenError if "pictures" not in words else DappledError, match=words):
            act()
    with pytest.raises(OpenError, match="is not a light field"):
        opened.light_field(_frame(tmp_path))
    with pytest.raises(AttributeError, match="no attribute 'close'"):
        dappled.close  # type: ignore[attr-defined]  # noqa: B018  it isn't there


def _frame(folder: Path) -> Path:
    """A file that is opened as a raw frame by a light field's door."""
    (folder / "b.dng").write_bytes(b"raw")
    return folder / "b.dng"


def test_an_array_is_decoded_with_the_lens_that_is_told_and_keeps_where_it_was_focused(tmp_path: Path) -> None:
    camera = reference_camera(1, scale=0.5, scene="bench")
    np.save(tmp_path / "frame.npy", camera.expose(0.0, 0).raw)
    frame = dappled.open(
        tmp_path / "frame.npy",
        camera="reference-36mm",
        mask="reference-5x5",
        focal_length_mm=50.0,
        f_number=7.4,
        focus_m=20.0,
        black=camera.sensor.black,
        white_level=camera.sensor.white,
    )
    assert isinstance(frame, OpenedFrame)
    metres = frame.light_field.metres()
    assert -metres.gain_px_m / metres.offset_px == pytest.approx(20.0)


def test_one_view_has_no_depth() -> None:
    with pytest.raises(DecodeError, match="depth needs views from several places"):
        OpenedLightField(light_field(n=1)).depth()


def test_a_light_field_shows_itself_in_a_line(path: Path) -> None:
    assert repr(dappled.open(path)) == (
        "<light field a.npz: 5 × 5 views of 60 × 80 px, 3 slices, reference-36mm, 50 mm, f/7.4>"
    )
    bare = opened.OpenedLightField(light_field(doubts=[CLIPPED], focal_length_mm=None, camera=None))
    assert repr(bare) == "<light field 5 × 5 views of 60 × 80 px, 3 slices, f/7.4, 1 doubt>"


def test_a_kind_is_asked_for_and_checked(path: Path) -> None:
    assert dappled.open(path, kind="light field").refocus().shape == (60, 80)
    with pytest.raises(OpenError, match="is a light field, not a flight: open it with kind='light field'"):
        dappled.open(path, kind="flight")
    with pytest.raises(OpenError, match="there is no kind 'film': choose light field, frame, flight"):
        dappled.open(path, kind="film")  # type: ignore[call-overload]  # mypy refuses it too


def test_a_notebook_shows_a_picture_and_the_doubts() -> None:
    found = OpenedLightField(light_field(doubts=[DEVELOPED]))
    shown = found._repr_html_()
    assert "5 × 5 views of 60 × 80 px" in shown
    assert "doubt: a &lt;JPEG&gt;: its tones are not linear" in shown
    (data,) = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', shown)
    with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
        assert picture.size == (80, 60)
        shown_px, middle = np.asarray(picture, dtype=float), found.views[2, 2]
    assert np.corrcoef(shown_px.ravel(), middle.ravel())[0, 1] > 0.95
    empty = replace(
        light_field(doubts=[CLIPPED] * 15),
        slices=np.ones((3, 0, 0), np.complex64),
        views=np.zeros((5, 5, 0, 0), np.float32),
    )
    assert OpenedLightField(empty)._repr_html_().endswith("<div>and 5 more</div>")
    bare = replace(light_field(), views=np.zeros((0, 0, 60, 80), np.float32), view_offsets=np.zeros((0, 0, 2)))
    assert "data:image/jpeg" in OpenedLightField(bare)._repr_html_()  # the mean, from slices alone


def pixels(axes: Axes) -> NDArray[Any]:
    """Of the image that was drawn last, NaN where masked."""
    return np.asarray(np.ma.filled(np.ma.asarray(axes.images[-1].get_array()), np.nan))


def test_views_slices_spectrum_and_depth_are_drawn(path: Path) -> None:
    found = opened.light_field(path)
    views = found.plot()
    assert views.get_title() == "5 × 5 views"
    assert pixels(views).shape == (300, 400)
    assert found.plot("slices").get_title() == "3 slices and their conjugates"
    spectrum = found.plot("spectrum")
    assert spectrum.get_xlim() == (-0.5, 0.5)
    ends = sorted(tuple(round(float(x), 3) for x in image.get_extent()) for image in spectrum.images)
    assert (0.05, 0.15, 0.05, -0.05) in ends  # carrier (0, 1) at 0.1 cycles/pixel; a band is 1/10 wide
    assert (-0.15, -0.05, 0.05, -0.05) in ends
    made = found.depth("contrast")
    drawn = found.plot("depth", depth=made, axes=views)
    assert drawn is views
    assert "contrast, " in drawn.get_title()
    np.testing.assert_array_equal(pixels(drawn), made.disparity)
    pyplot.close("all")


def test_what_cannot_be_drawn_is_told(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = opened.light_field(path)
    with pytest.raises(OpenError, match="'picture' can't be drawn: choose views, slices, spectrum or depth"):
        found.plot("picture")  # type: ignore[arg-type]  # mypy refuses it too
    with pytest.raises(OpenError, match="a depth map is no part of a picture of views"):
        found.plot("views", depth=found.depth("contrast"))
    with pytest.raises(OpenError, match=r"the depth map is \(30, 40\), the views are \(60, 80\)"):
        found.plot("depth", depth=OpenedLightField(light_field(shape=(30, 40))).depth("contrast"))
    none = replace(light_field(), slices=np.zeros((0, 60, 80), np.complex64), carriers=np.zeros((0, 4)))
    with pytest.raises(DappledError, match="has no slices"):
        OpenedLightField(none).plot("slices")
    with pytest.raises(DappledError, match="has no slices"):
        OpenedLightField(none).plot("spectrum")
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(DappledError, match=r"matplotlib"):
        found.plot()


def test_a_frame_is_shown_without_being_decoded_and_drawn_with_its_own_spectrum(tmp_path: Path) -> None:
    (tmp_path / "frame.dng").write_bytes(reference_camera(1, scale=0.5, scene="white").expose(0.0, 0).file)
    frame = dappled.open(tmp_path / "frame.dng", kind="frame", mask="reference-5x5")
    assert repr(frame) == "<frame frame.dng, reference-5x5>"
    assert "img" not in frame._repr_html_()
    drawn = frame.plot("spectrum")
    assert pixels(drawn).shape[2] == 3  # in colour: boxes on a grey spectrum
    assert "img" in frame._repr_html_()
    pyplot.close("all")


@pytest.mark.parametrize("name", ["mask.toml", "flight.tlog", "log.ulg"])
def test_a_file_that_is_no_frame_is_not_called_one(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"anything")
    recipes: tuple[dict[str, Any], ...] = ({}, {"mask": "mask-2"})
    for recipe in recipes:
        with pytest.raises(opened.OpenError, match=rf"{name} is no frame: open takes"):
            opened.open(tmp_path / name, **recipe)
