"""`dappled calibrate --target`, from frames of boards at known distances to metres by command."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dappled.cli import main
from dappled.cli.calibrate.target import from_frames, misfits
from dappled.decode.depth.ranging import Target, fit_targets
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Code
from dappled.mocks.scene.masked_camera import reference_camera
from tests.system.test_depth import target

SEED = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("targets")
    camera = reference_camera(SEED, scale=0.5, scene="bench")
    (made / "bench.dng").write_bytes(camera.bench_frame().file)
    for metres in (2, 6):
        (made / f"{metres}.dng").write_bytes(target(camera, SEED, metres).expose(0.0, metres).file)
    assert main(["calibrate", str(made / "bench.dng"), "--mask", "reference-5x5", "-o", str(made / "c.toml")]) == 0
    return made


@pytest.mark.long
def test_targets_lead_to_metres(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with_mask = ["--mask", "reference-5x5", "--calibration", str(folder / "c.toml")]
    frames = [str(folder / f"{metres}.dng") for metres in (2, 6)]
    assert main(["calibrate", *frames, "--target", "2", "6", *with_mask, "-o", str(folder / "m.toml")]) == 0
    assert "px·m" in capsys.readouterr().out
    told = tomllib.loads((folder / "m.toml").read_text())["ranging"]
    assert told["gain_px_m"] == pytest.approx(33.5, rel=0.01)
    words = ["--mask", "reference-5x5", "--calibration", str(folder / "m.toml"), "-o", str(folder / "lf.npz")]
    assert main(["decode", str(folder / "6.dng"), *words]) == 0
    capsys.readouterr()
    assert main(["depth", str(folder / "lf.npz"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["distance_m"][1] == pytest.approx(6.0, rel=0.01)
    assert found["distances_from"] == "2 targets"
    assert told["focal_length_mm"] == 50.0


@pytest.mark.long
def test_frames_of_several_zooms_are_no_targets(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second frame says that the lens was zoomed in between."""
    recipe = Recipe("reference-36mm", "reference-5x5", calibration=str(folder / "c.toml"))
    honest = Darkroom.decode

    def zoomed(self: Darkroom, path: Path, **asked: Any) -> DecodeResult:
        done = honest(self, path, **asked)
        said = {**done.light_field.attributes, "focal_length_mm": 50.0 if path.stem == "2" else 70.0}
        return replace(done, light_field=replace(done.light_field, attributes=said))

    monkeypatch.setattr(Darkroom, "decode", zoomed)
    with pytest.raises(DappledError, match=r"several focal lengths \(50, 70\)"):
        from_frames(recipe, [folder / "2.dng", folder / "6.dng"], [2.0, 6.0])


def test_targets_without_a_distance_each_are_told_before_a_frame_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [tmp_path / f"{metres}.dng" for metres in (2, 6)]
    for frame in frames:
        frame.touch()
    words = [*map(str, frames), "--mask", "reference-5x5", "-o", str(tmp_path / "m.toml")]
    assert main(["calibrate", *words, "--target", "2"]) == 1
    assert "give --target one distance per frame" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == frames


def test_a_target_at_another_distance_than_was_told_is_named() -> None:
    paths = [Path(f"{metres}.dng") for metres in (2, 3, 6)]
    for told, named in ((3.0, []), (3.1, [(Code.TARGETS_DISAGREE, "3.dng")])):
        targets = [Target(z, 33.5 / z - 16.0, 0.02) for z in (2.0, 3.0, 6.0)]
        targets[1] = replace(targets[1], distance_m=told)
        found = misfits(fit_targets(targets, f_number=7.4), paths, targets)
        assert [(one.code, one.subject.which) for one in found] == named
    assert misfits(fit_targets(targets[:2], f_number=7.4), paths[:2], targets[:2]) == []


@pytest.mark.slow
def test_targets_in_another_order_are_told(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [str(folder / f"{metres}.dng") for metres in (2, 6)]
    with_mask = ["--mask", "reference-5x5", "--calibration", str(folder / "c.toml"), "-o", str(tmp_path / "m.toml")]
    assert main(["calibrate", *frames, "--target", "6", "2", *with_mask]) == 1
    assert "in the order of the frames" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
