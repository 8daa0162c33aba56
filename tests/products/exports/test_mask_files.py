"""Mask files: what was drawn is what is read, with its physical size; CSV of people."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dappled.decode.optics import laser_bench
from dappled.decode.optics.carriers import Mask
from dappled.decode.optics.film import MaskImage, film_of
from dappled.errors import DappledError
from dappled.products.exports import mask_files
from tests.decode.optics.equations import spots


@pytest.mark.parametrize("name", ["mask.png", "mask.tif"])
@pytest.mark.parametrize("bits", [8, 16])
def test_written_and_read_back(tmp_path: Path, name: str, bits: int) -> None:
    image = MaskImage(Mask(9.1, 3, "full"), film_of(700, 1100, 113.8), (12.5, 12.5), bits=bits)
    done: list[int] = []
    mask_files.write(tmp_path / name, image.film.shape, bits, (113.8, 227.6), image.levels, progress=done.append)
    values, density = mask_files.read(tmp_path / name)
    np.testing.assert_allclose(values * (2**bits - 1), image.levels(slice(None), slice(None)), atol=0.01)
    assert density == pytest.approx((113.8, 227.6), rel=1e-4)
    assert sum(done) == 1100
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", ["mask.png", "mask.tif"])
def test_a_written_mask_propagated_lands_on_table_7(tmp_path: Path, name: str) -> None:
    image = MaskImage(Mask(11.38, 2, "diagonal"), film_of(700, 700, 113.8), (10, 10), negative=True)
    mask_files.write(tmp_path / name, (700, 700), 8, (113.8, 113.8), image.levels)
    values, density = mask_files.read(tmp_path / name)
    pitch = 1 / density[0], 1 / density[1]
    field = (1 - values.astype(np.float64)) * laser_bench.beam((700, 700), pitch, 2.0)
    seen = spots(laser_bench.far_screen(field, pitch, 532, 0.5842, samples=1024), separation_mm=1.5)
    expected = [(0.0, 0.0), *((a * r, b * r) for r in (3.54, 7.07) for a in (1, -1) for b in (1, -1))]
    assert len(seen) >= 9
    for x, y in expected:
        assert min(np.hypot(s.x_mm - x, s.y_mm - y) for s in seen[:9]) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["big.png", pytest.param("big.tif", marks=pytest.mark.long)])
def test_a_16k_mask_takes_less_than_200_mb(tmp_path: Path, name: str) -> None:
    code = (
        "import sys; from dappled.cli import main; assert main(sys.argv[1:]) == 0; "
        "print(*(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')), file=sys.stderr)"
    )
    words = ["mask", "make", "mask-2-full", "--film", "16k", "-o", str(tmp_path / name)]
    done = subprocess.run([sys.executable, "-c", code, *words], check=True, timeout=110, capture_output=True, text=True)
    assert 10_000 < int(done.stderr.split()[-1]) < 200_000  # kB, of this process alone


def test_a_wrong_file_is_answered(tmp_path: Path) -> None:
    tile = MaskImage(Mask(11.38, 2), film_of(50, 50, 113.8), (10, 10)).levels
    with pytest.raises(DappledError, match=r"must end in .png or .tif"):
        mask_files.write(tmp_path / "mask.jpg", (50, 50), 8, (113.8, 113.8), tile)
    with pytest.raises(DappledError, match="can't be written"):
        mask_files.write(tmp_path / "nowhere" / "mask.png", (50, 50), 8, (113.8, 113.8), tile)
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DappledError, match="can't be read as an image"):
        mask_files.read(tmp_path / "text.png")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x,y\n1,2\n", "no column x_mm"),
        ("x_mm,y_mm\n1,two\n", "line 2: could not convert"),
        ("", "no column x_mm"),
    ],
)
def test_a_wrong_csv_is_answered(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "spots.csv").write_text(text)
    with pytest.raises(DappledError, match=said):
        mask_files.read_spots(tmp_path / "spots.csv")


def test_csv_of_people(tmp_path: Path) -> None:
    (tmp_path / "spots.csv").write_text("\ufeffX_mm, y_mm ,note\n3, -3,near\n-,-,not seen\n7.1,7.1,\n", "utf-8")
    assert mask_files.read_spots(tmp_path / "spots.csv") == [(3.0, -3.0), (7.1, 7.1)]
    (tmp_path / "curve.csv").write_text("level,density\n255,0.1\n0,2.1\n128,0.9\n")
    assert mask_files.read_density_curve(tmp_path / "curve.csv").range == pytest.approx((10**-2.1, 10**-0.1))
    (tmp_path / "bad.csv").write_text("level,density\n255,0.1\n0,2.1\n128,5.9\n")
    with pytest.raises(DappledError, match=r"bad.csv: the density reverses"):
        mask_files.read_density_curve(tmp_path / "bad.csv")
