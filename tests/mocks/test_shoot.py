from __future__ import annotations

from pathlib import Path

import numpy as np

from dappled.drivers.raw import reading
from dappled.mocks.shoot import main


def test_a_frame_and_its_truth_are_written(tmp_path: Path) -> None:
    words = [str(tmp_path / "a.dng"), "--scale", "0.2", "--f-number", "59.2", "--truth", str(tmp_path / "a.npz")]
    assert main(words) == 0
    frame = reading.read(tmp_path / "a.dng")
    assert frame.mosaic.shape == (556, 738)
    assert (frame.focal_length_mm, frame.f_number) == (50.0, 59.2)
    with np.load(tmp_path / "a.npz") as truth:
        assert truth["views"].shape[:2] == (5, 5)
