"""Each form read back as its own readers read it."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import io

from dappled.decode.depth import estimate, evidence
from dappled.decode.lightfield.light_field import ViewStack
from dappled.errors import DappledError
from dappled.products.exports import exports, view_folders
from tests.products.fields import DISPARITY, light_field


def read_pfm(path: Path) -> np.ndarray:
    """As HCI's evaluation toolkit reads it."""
    with path.open("rb") as file:
        assert file.readline().rstrip() == b"Pf"
        found = re.match(rb"^(\d+)\s(\d+)\s$", file.readline())
        assert found is not None
        width, height = map(int, found.groups())
        assert float(file.readline()) < 0
        return np.flipud(np.frombuffer(file.read(), "<f4").reshape(height, width))


@pytest.mark.parametrize(("colour", "lenslet"), [(False, True), (True, False)])
def test_an_hci_folder_comes_back(tmp_path: Path, colour: bool, lenslet: bool) -> None:
    field = light_field(colour=colour, lenslet=lenslet)
    found = estimate.estimate(evidence.of_views(ViewStack.of(field)), between=(0, 1))
    exports.hci(tmp_path / "hci", field, found)
    assert len(list((tmp_path / "hci").glob("input_Cam*.png"))) == 25
    parser = configparser.ConfigParser()
    parser.read(tmp_path / "hci" / "parameters.cfg")
    assert parser.getint("extrinsics", "num_cams_x") == 5
    assert parser.getfloat("intrinsics", "focal_length_mm") == 50
    np.testing.assert_array_equal(read_pfm(tmp_path / "hci" / "disp_estimate.pfm"), found.disparity)
    back = view_folders.read(tmp_path / "hci")
    assert back.views.shape == field.views.shape
    again = estimate.estimate(evidence.of_views(ViewStack.of(back)), between=(0, 1))
    assert np.nanmedian(again.disparity) == pytest.approx(DISPARITY, abs=0.01)
    white = parser.getfloat("dappled", "white")
    ordered = exports.as_cameras(ViewStack.of(field))
    assert np.median(np.abs(back.views * white - ordered)) < 0.005


@pytest.mark.parametrize("lenslet_px", [0, 14])
def test_an_eslf_picture_comes_back(tmp_path: Path, lenslet_px: int) -> None:
    """As LFReadESLF: reshape to (lenslet, rows, lenslet, columns)."""
    cv2 = pytest.importorskip("cv2", reason="a reader of 16-bit colour PNGs, an extra")
    field = light_field(colour=True)
    exports.eslf(tmp_path / "a.png", field, lenslet_px)
    told = dict(line.split(" = ") for line in (tmp_path / "a.txt").read_text().splitlines())
    side = int(told["lenslet_px"])
    assert side == (lenslet_px or 5)
    sheet = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert sheet.dtype == np.uint16
    lf = sheet.reshape(60, side, 80, side, 3).transpose(1, 3, 0, 2, 4)
    first = (side - 5) // 2
    views = lf[first : first + 5, first : first + 5] / 65535 * float(told["white"])
    wanted = exports.as_cameras(ViewStack.of(field))
    assert np.abs(views - np.minimum(wanted, float(told["white"]))).max() < 1e-4
    assert lf.max() == 65535
    if first:
        assert lf[0].max() == 0


def test_a_mat_file_is_lftoolbox_s(tmp_path: Path) -> None:
    field = light_field(n=3, colour=True)
    exports.mat(tmp_path / "a.mat", field)
    assert (tmp_path / "a.mat").read_bytes()[:19] == b"MATLAB 5.0 MAT-file"
    found = io.loadmat(tmp_path / "a.mat")
    lf = found["LF"]
    assert lf.shape == (3, 3, 60, 80, 4)  # [t, s, v, u, c]
    assert lf.dtype == np.uint16
    assert (lf[..., 3] == 65535).all()
    white = float(found["DecodeOptions"]["White"][0, 0][0, 0])
    wanted = exports.as_cameras(ViewStack.of(field))
    assert np.abs(lf[..., :3] / 65535 * white - np.minimum(wanted, white)).max() < 1e-4
    assert found["LFMetadata"]["camera"][0, 0][0] == "reference-36mm"


@pytest.mark.parametrize(("n", "columns", "rows"), [(5, 5, 1), (9, 3, 3)])
def test_a_quilt_begins_at_the_lower_left_with_the_leftmost_view(
    tmp_path: Path, n: int, columns: int, rows: int
) -> None:
    field = light_field(n=n)
    named = exports.quilt(tmp_path / "q.png", field)
    assert named.name == f"q_qs{columns}x{rows}a1.333.png"
    sheet = np.asarray(Image.open(named)).astype(float)
    assert sheet.shape == (60 * rows, 80 * columns)
    stack = ViewStack.of(field)
    middle = n // 2
    left_most = stack.views[middle, int(np.argmax(stack.column_steps))]
    tile = sheet[-60:, :80]
    assert np.corrcoef(tile.ravel(), left_most.ravel())[0, 1] > 0.98
    right_most = stack.views[middle, int(np.argmin(stack.column_steps))]
    assert np.corrcoef(tile.ravel(), right_most.ravel())[0, 1] < 0.97


def test_nothing_is_overwritten_and_misfits_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = light_field(n=3)
    exports.mat(tmp_path / "a.mat", field)
    with pytest.raises(DappledError, match="exists already"):
        exports.mat(tmp_path / "a.mat", field)
    with pytest.raises(DappledError, match="don't fit into lenslets of 2 px"):
        exports.eslf(tmp_path / "e.png", field, 2)
    monkeypatch.setattr(exports, "_LARGEST_MAT", 10)
    with pytest.raises(DappledError, match="export as h5"):
        exports.mat(tmp_path / "b.mat", field)
    with pytest.raises(DappledError, match="can't be written"):
        exports.hci(tmp_path / "gone" / "hci", field)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mat"]


def test_an_eslf_picture_leaves_a_text_of_its_name_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("of a day in the field")
    with pytest.raises(DappledError, match=r"notes\.txt exists already"):
        exports.eslf(tmp_path / "notes.png", light_field())
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("notes.txt", "of a day in the field")]
