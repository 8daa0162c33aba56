"""What Debian's rnx2rtkp computes of RTKLIB's own sample is read, in each of its forms, at the place of the station."""

from __future__ import annotations

import math
import shutil
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from dappled.decode.geometry import camera_pose
from dappled.products.geotags import pos_file
from dappled.products.geotags.pos_file import PosFile
from tests.needs import without

SAMPLE = Path(__file__).parent / "rtklib_sample"
BASE = ("-3978242.4348", "3382841.1715", "3649902.7667")  # of station 3040, in RTKLIB's own test/utest/rnx2rtkp
STATION = np.array([-3976219.5082, 3382372.5671, 3652512.9849])  # 0759, to decimetres: the header of its file
FIRST = datetime(2005, 4, 1, 23, 59, 47, tzinfo=UTC)  # 13 leap seconds before midnight of GPS time
FORMS = {"week": (), "date": ("-t",), "UTC": ("-u", "-t"), "degrees, minutes": ("-g",), "ECEF": ("-e",),
         "commas": ("-s", ",")}  # fmt: skip


def solved(folder: Path, *options: str) -> PosFile:
    """What dappled reads of rnx2rtkp's kinematic solution of 0759 against 3040."""
    program = shutil.which("rnx2rtkp")
    if program is None:
        without("Debian's rtklib has rnx2rtkp")
    names = [str(SAMPLE / name) for name in ("07590920.05o", "30400920.05o", "07590920.05n")]
    path = folder / "rover.pos"
    subprocess.run(
        [program, "-p", "2", *options, "-r", *BASE, "-o", str(path), *names],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    return pos_file.read(path)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_rnx2rtkp_is_read(form: str, tmp_path: Path) -> None:
    marks = solved(tmp_path, *FORMS[form]).marks
    assert [mark.utc_ns for mark in marks] == [
        round((FIRST + timedelta(seconds=30 * n)).timestamp()) * 10**9 for n in range(10)
    ]
    plain = solved(tmp_path).marks
    for mark, same in zip(marks, plain, strict=True):
        here, there = (camera_pose.to_ecef(one.latitude_rad, one.longitude_rad, one.height_m) for one in (mark, same))
        assert math.dist(here, there) < 1e-3  # the forms have 0.1 to 0.3 mm
        assert math.dist(here, STATION) < 0.3
        assert mark.solution == "fix"
        assert mark.satellites == 7
        assert mark.covariance_m2 == pytest.approx(same.covariance_m2, abs=3e-6)  # 0.1 mm of 1 cm
        nn, _, _, ee, _, dd = mark.covariance_m2 or (0.0,) * 6
        assert 0.003 < math.sqrt(ee) < math.sqrt(nn) < math.sqrt(dd) < 0.02
