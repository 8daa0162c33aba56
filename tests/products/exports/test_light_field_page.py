"""The second program of docs/lightfield.md rebuilds every slice of a light field from its raw frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.mocks.scene import dng
from dappled.mocks.scene.masked_camera import ISO, MAKE, MODEL, reference_camera
from dappled.products.exports import light_files

PAGE = Path(__file__).parents[3] / "docs" / "lightfield.md"


@pytest.mark.slow
def test_the_page_rebuilds_the_slices_of_a_frame_with_a_colour_cast(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = reference_camera(1, scale=0.5, scene="bench")
    light = camera.expose(0.0, 0).raw.astype(np.float64) - camera.sensor.black
    ramp = np.linspace(0.4, 1.0, light.shape[1] // 2)
    light[0::2, 0::2] *= ramp  # red grows to the right, blue falls: what the colour step is for
    light[1::2, 1::2] *= ramp[::-1]
    exif = dng.Exif(MAKE, MODEL, "SIM1", 50.0, 7.4, 1e-3, ISO, 0)
    raw = np.rint(light + camera.sensor.black).astype(np.uint16)
    file = dng.encode(raw, black=camera.sensor.black, white=camera.sensor.white, exif=exif)
    (tmp_path / "frame.dng").write_bytes(file)
    made = Darkroom(Recipe("auto", "reference-5x5")).decode(tmp_path / "frame.dng", views=False)
    light_files.save(tmp_path / "frame.npz", made.light_field)
    monkeypatch.chdir(tmp_path)
    programs = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (program,) = (one for one in programs if "rawpy" in one)
    exec(program, {})  # noqa: S102  # our own page
    told = capsys.readouterr().out.splitlines()
    assert len(told) == made.light_field.slices.shape[0] == 13
    worst = max(float(line.rpartition(" ")[2]) for line in told)
    assert worst < 1e-4, told
