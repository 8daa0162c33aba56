"""Which camera a recipe means: looked for once for all frames of a model, and read anew for each decoder."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.config import profiles
from dappled.drivers.raw.darkroom import camera_profile
from dappled.drivers.raw.recipe import Recipe, camera_name

SHIPPED = Path(profiles.__file__).parent / "profiles" / "cameras" / "reference-36mm.toml"


def test_the_profiles_are_searched_once_for_all_frames_of_a_model(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[str] = []
    monkeypatch.setattr(profiles, "camera_for_model", searched.append)
    assert [camera_name("auto", "Nobody's Model 7") for _ in range(3)] == ["Nobody's Model 7"] * 3
    assert searched == ["Nobody's Model 7"]


def test_a_profile_that_was_edited_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    recipe = Recipe(camera=str(file), mask="mask-1")
    file.write_text(SHIPPED.read_text("utf-8").replace("mask_distance_mm = ", "mask_distance_mm = 1", 1), "utf-8")
    first = camera_profile(recipe, "").mask_distance_mm
    file.write_text(SHIPPED.read_text("utf-8"), "utf-8")
    assert camera_profile(recipe, "").mask_distance_mm != first
