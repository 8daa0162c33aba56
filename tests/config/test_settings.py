"""The configuration door: what is right gets through, what is wrong is named with file, line and key."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from dappled.config import settings
from dappled.config.schema import ConfigError, TomlSource


def parse(text: str) -> settings.Settings:
    return settings.parse(tomllib.loads(text), TomlSource("test.toml", text))


def test_empty_file_is_a_whole_configuration(tmp_path: Path) -> None:
    file = tmp_path / "empty.toml"
    file.write_text("")
    loaded = settings.load(file)
    assert loaded.camera.driver == "gphoto2"
    assert loaded.publish.slices.startswith("ipc:///")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[camera]\n\nprot = 3", "test.toml, line 3: [camera] prot is not a known key; did you mean 'port'?"),
        ("[camra]\n", "test.toml, line 1: camra is not a known table; did you mean [camera]?"),
        ("camera = 3", "must be a table"),
        ("[camera]\nport = 3", "line 2: [camera] port must be text, not 3"),
        ("[camera]\nmax_pending = true", "must be a whole number"),
        ("[camera]\nmax_pending = 0", "must lie between 1 and 1000"),
        ("[camera]\nlatency_ms = nan", "must be a finite number"),
        ("[camera]\ncapture_target = 'tape'", "must be one of card, ram"),
        ("[mavlink]\nurl = [1]", "[mavlink] url[0] must be text"),
        ("[decode]\nlaw = 'ohm'", "must be one of"),
    ],
)
def test_wrong_values_are_named(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=r".") as caught:
        parse(text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('kind = "dappled calibration"\nversion = 1\nfits = []\n', "is a calibration, no settings: .* in \\[decode\\]"),
        ("p = 2\nfrequency_per_mm = 11.38\n", "is a mask's profile, no settings: .* in \\[mask\\]"),
        ('law = "fd"\n[[raw]]\nname = "all"\n', "is a camera's profile, no settings: .* in \\[camera\\]"),
    ],
)
def test_another_kind_of_file_is_named_in_one_sentence(text: str, said: str) -> None:
    """Not a line for each of its keys, with the settings that they resemble."""
    with pytest.raises(ConfigError, match=f"^test.toml {said}$"):
        parse(text)


def test_url_may_be_one_or_a_list() -> None:
    assert parse("[mavlink]\nurl = 'udpin:127.0.0.1:14550'").mavlink.url == ("udpin:127.0.0.1:14550",)
    assert parse("[mavlink]\nurl = ['a', 'b']").mavlink.url == ("a", "b")


def test_missing_and_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        settings.load(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("[camera\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        settings.load(broken)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 100_000, "nests more than 64 deep"),
        ("[mavlink]\ncomponent_id = " + "1" * 5000, "more than 20 digits"),
        ("[mavlink]\ncomponent_id = " + "1" * 26, "beyond 64 bits"),
        ("[camera]\nport = '" + "a" * 5_000_000 + "'", "longer than 4.19 MB"),
        ("[mavlink]\nurl = [[" + "1, " * 100_000 + "]]", "must be text"),
    ],
)
def test_hostile_files_are_named_in_a_short_sentence(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "hostile.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words) as caught:
        settings.load(file)
    assert "hostile.toml" in str(caught.value)
    assert len(str(caught.value)) < 500


def test_relative_paths_stand_beside_the_file(tmp_path: Path) -> None:
    file = tmp_path / "sub" / "dappled.toml"
    file.parent.mkdir()
    file.write_text("[record]\ndirectory = 'flights'\n[decode]\ncalibration = 'c.toml'\n")
    loaded = settings.load(file)
    assert loaded.record.directory == str(tmp_path / "sub" / "flights")
    assert loaded.decode.calibration == str(tmp_path / "sub" / "c.toml")


def test_settings_survive_a_round_trip_through_toml() -> None:
    loaded = settings.load(None)
    text = tomli_w.dumps(settings.to_tables(loaded))
    assert settings.resolve(parse(text)) == loaded


@given(st.dictionaries(st.sampled_from([*settings.TABLES, "x"]), st.dictionaries(st.text(max_size=8), st.integers())))
def test_any_tables_give_settings_or_one_sentence(tables: dict[str, dict[str, int]]) -> None:
    said = "any"
    try:
        settings.parse(tables, TomlSource("any"))
    except ConfigError as error:
        said = str(error)
    assert said.startswith("any")
