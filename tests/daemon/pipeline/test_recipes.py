"""What decoding was given, and the flight's own copies of it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled.config import settings as configuration
from dappled.config.schema import ConfigError
from dappled.config.settings import CameraSettings, DecodeSettings, MaskSettings, Settings
from dappled.daemon.pipeline import recipes
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError

SETTINGS = Settings(camera=CameraSettings(profile="reference-36mm"), mask=MaskSettings("reference-5x5"))


def test_names_and_recipe_from_settings() -> None:
    names, made = recipes.recipe(SETTINGS)
    assert (names.camera, names.mask, names.law) == ("reference-36mm", "reference-5x5", "geometric")
    assert made == Recipe("reference-36mm", "reference-5x5", try_laws=True)


@pytest.mark.parametrize("changed", [{"mask": MaskSettings()}, {"decode": DecodeSettings(enabled=False)}])
def test_without_a_mask_or_when_told_so_nothing_is_decoded(changed: dict[str, object]) -> None:
    _, made = recipes.recipe(replace(SETTINGS, **changed))  # type: ignore[arg-type]  # fields by name
    assert made is None


@pytest.mark.parametrize(
    "changed",
    [
        {"mask": MaskSettings("mask-77")},
        {"camera": CameraSettings(profile="no-such-camera")},
        {"decode": DecodeSettings(white="/nowhere/white.png")},
        {"decode": DecodeSettings(calibration="/nowhere/calibration.toml")},
    ],
)
def test_what_is_not_there_is_told_before_the_flight(changed: dict[str, object]) -> None:
    with pytest.raises(DappledError):
        recipes.recipe(replace(SETTINGS, **changed))  # type: ignore[arg-type]  # fields by name


def test_an_unknown_profile_is_a_wrong_call() -> None:
    with pytest.raises(ConfigError) as caught:
        recipes.recipe(replace(SETTINGS, mask=MaskSettings("mask-77")))
    assert caught.value.exit_code == 2


def test_a_flight_keeps_its_own_copies_and_replays_by_them(tmp_path: Path) -> None:
    white = tmp_path / "white.npy"
    np.save(white, np.ones((8, 8), np.uint16))
    settings = replace(SETTINGS, decode=DecodeSettings(white=str(white)))
    flight = tmp_path / "flight"
    flight.mkdir()
    _, made = recipes.recipe(settings)
    assert made is not None
    kept = recipes.keep(made, flight)
    white.unlink()
    for path in (kept.camera, kept.mask, kept.white):
        assert Path(path).is_file()
        assert flight in Path(path).parents
    facts = {"settings": configuration.to_tables(settings)}
    assert recipes.of_flight(flight, facts, {}) == replace(kept, try_laws=False)  # a replay decides nothing
    other = recipes.of_flight(flight, facts, {"mask": "mask-1", "white": None})
    assert other is not None
    assert (other.mask, other.white) == ("mask-1", kept.white)


def test_copies_that_can_t_be_made_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(DappledError, match="can't be copied"):
        recipes.keep(Recipe("reference-36mm", "reference-5x5", white=str(tmp_path / "gone.png")), tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(DappledError, match="can't be copied"):
        recipes.keep(Recipe("reference-36mm", "reference-5x5"), tmp_path / "file")


def test_versions_name_what_results_depend_on() -> None:
    assert {"python", "numpy", "scipy", "rawpy"} <= set(recipes.versions())


def test_a_daemon_checks_its_recipe_without_what_decodes(tmp_path: Path) -> None:
    """SciPy is a third of a start with a mask, which is to be ready soon."""
    file = tmp_path / "dappled.toml"
    file.write_text(f'[mask]\nprofile = "mask-2"\n[record]\ndirectory = "{tmp_path}"\n')
    program = (
        "import sys, pathlib\n"
        "from dappled.cli import run\n"
        "from dappled.config import settings\n"
        "from dappled.daemon import settings_check\n"
        "from dappled.daemon.pipeline import recipes\n"
        "file = settings.examine_file(pathlib.Path(sys.argv[1]))\n"
        "assert recipes.recipe(settings_check.checked(file, starting=True))[1] is not None\n"
        "print('scipy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program, str(file)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
