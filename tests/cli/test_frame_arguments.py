"""Frames by name, by folder and by flight; what is there is not replaced unasked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dappled.cli import VERBS, frame_arguments, main
from dappled.cli.command_line import options, parser
from dappled.cli.verb import Overwriting
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError

FOLDERS = {"batch", "geotag"}  # their -o is a folder that they add to
WRITERS = {
    "decode": ["x.dng", "--mask", "m"],
    "calibrate": ["x.dng"],
    "views": ["x.zarr"],
    "refocus": ["x.zarr"],
    "export": ["x.zarr", "--as", "npz"],
    "depth": ["x.zarr"],
}


def test_a_folder_stands_for_the_frames_in_it(tmp_path: Path) -> None:
    flight, folder = tmp_path / "flight", tmp_path / "card"
    (flight / "frames").mkdir(parents=True)
    folder.mkdir()
    (flight / "flight.toml").touch()
    for name in ("000001.cr2", "000000.cr2", "000000.jpg", "000000.cr2.xmp", "stray-1.cr2"):
        (flight / "frames" / name).touch()
    for name in ("B.RAF", "A.dng", "notes.txt", "._B.RAF"):
        (folder / name).touch()
    alone = tmp_path / "one.dng"
    found = frame_arguments.frames([alone, flight, folder])
    assert [path.name for path in found] == ["one.dng", "000000.cr2", "000001.cr2", "A.dng", "B.RAF"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DappledError, match="empty holds no frame"):
        frame_arguments.frames([tmp_path / "empty"])


@pytest.mark.parametrize("verb", WRITERS)
def test_each_verb_that_writes_a_named_output_has_the_same_word_for_replacing_it(verb: str) -> None:
    words = [verb, *WRITERS[verb], "-o", "out.npz"]
    assert parser(verb).parse_args(words).overwrite is False
    assert parser(verb).parse_args([*words, "--overwrite"]).overwrite is True


def test_what_is_there_is_refused_by_name_and_with_the_remedy(tmp_path: Path) -> None:
    there, dangling = tmp_path / "there.png", tmp_path / "link.png"
    there.touch()
    dangling.symlink_to(tmp_path / "nowhere")
    for path in (there, dangling):
        with pytest.raises(DappledError, match=rf"{path.name} exists already: .*--overwrite"):
            Overwriting().refuse_existing(tmp_path / "new.png", path)
    Overwriting().refuse_existing(tmp_path / "new.png", None)
    Overwriting(overwrite=True).refuse_existing(there)


@pytest.mark.parametrize("given", ["c", "c.toml", "c.npz"])
@pytest.mark.parametrize("there", ["c.toml", "c.npz"])
def test_a_calibration_replaces_neither_of_its_files_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: str, there: str
) -> None:
    (tmp_path / there).write_bytes(b"of before")
    (tmp_path / "x.dng").touch()
    assert main(["calibrate", str(tmp_path / "x.dng"), "--mask", "mask-2", "-o", str(tmp_path / given)]) == 1
    assert f"{there} exists already: " in capsys.readouterr().err
    assert (tmp_path / there).read_bytes() == b"of before"


@pytest.mark.parametrize(("kind", "words"), [("npz", "--overwrite replaces it"), ("mat", "move it away")])
def test_an_export_is_refused_with_a_remedy_that_works(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, words: str
) -> None:
    out, field = tmp_path / "out.npz", str(tmp_path)
    out.touch()
    assert main(["export", field, "--as", kind, "-o", str(out)]) == 1
    assert words in capsys.readouterr().err
    if kind == "mat":
        assert main(["export", field, "--as", kind, "-o", str(tmp_path / "new.mat"), "--overwrite"]) == 2
        assert "remove what is there yourself" in capsys.readouterr().err


def test_a_flights_frames_are_decoded_by_its_own_recipe(tmp_path: Path) -> None:
    flight = tmp_path / "f"
    (flight / "frames").mkdir(parents=True)
    (flight / "inputs" / "masks").mkdir(parents=True)
    (flight / "inputs" / "masks" / "mask-2.toml").touch()
    (flight / "flight.toml").write_text(
        '[settings.mask]\nprofile = "mask-2"\n[settings.decode]\ncalibration = "/gone/mine.toml"\nworkers = 1\n'
    )
    asked = Recipe(camera="auto", mask="", workers=2, colour=True, try_laws=True)
    for given in (flight, flight / "frames", flight / "frames" / "000000.dng"):
        made = frame_arguments.recorded([given], asked)
        assert made.mask == str(flight / "inputs" / "masks" / "mask-2.toml")
        assert made.calibration == str(flight / "inputs" / "calibration.toml")
        assert (made.workers, made.colour, made.try_laws) == (2, True, True)
    assert frame_arguments.recorded([flight], replace(asked, calibration="c")).calibration == "c"
    assert frame_arguments.recorded([flight], replace(asked, mask="mask-1")).calibration == ""
    with pytest.raises(DappledError, match=r"no mask is named: give --mask P"):
        frame_arguments.recorded([tmp_path / "x.dng"], asked)
    with pytest.raises(DappledError, match="not the frames of one flight"):
        frame_arguments.recorded([flight, tmp_path / "x.dng"], asked)
    (flight / "flight.toml").write_text("[settings]\n")
    with pytest.raises(DappledError, match="recorded without a mask"):
        frame_arguments.recorded([flight], asked)


@pytest.mark.slow  # it loads every verb
def test_every_verb_with_a_named_output_can_be_told_to_replace_it() -> None:
    missing = {
        path
        for path in VERBS
        if {"--output", "--picture", "--index"} & set(given := options(path)) and "--overwrite" not in given
    }
    assert missing - FOLDERS == set()
