"""Frames by name, by folder and by flight; what is there is not replaced unasked."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from dappled.cli import VERBS, completion, decode_arguments, main, parser
from dappled.cli.arguments import OutputExistsError, refuse_existing
from dappled.errors import DappledError

FOLDERS = {"batch", "geotag", "georeference"}  # their -o is a folder that they add to
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
    found = decode_arguments.frames([alone, flight, folder])
    assert [path.name for path in found] == ["one.dng", "000000.cr2", "000001.cr2", "A.dng", "B.RAF"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DappledError, match="empty holds no frame"):
        decode_arguments.frames([tmp_path / "empty"])


@pytest.mark.parametrize("verb", WRITERS)
def test_each_verb_that_writes_a_named_output_has_the_same_word_for_replacing_it(verb: str) -> None:
    words = [verb, *WRITERS[verb], "-o", "out.npz"]
    assert parser(verb).parse_args(words).overwrite is False
    assert parser(verb).parse_args([*words, "--overwrite"]).overwrite is True


def test_what_is_there_is_refused_by_name_and_with_the_remedy(tmp_path: Path) -> None:
    there, dangling = tmp_path / "there.png", tmp_path / "link.png"
    there.touch()
    dangling.symlink_to(tmp_path / "nowhere")
    kept = argparse.Namespace(overwrite=False)
    for path in (there, dangling):
        with pytest.raises(OutputExistsError, match=rf"{path.name} exists already: .*--overwrite"):
            refuse_existing(kept, tmp_path / "new.png", path)
    refuse_existing(kept, tmp_path / "new.png")
    refuse_existing(argparse.Namespace(overwrite=True), there)


@pytest.mark.parametrize("given", ["c", "c.toml", "c.npz"])
@pytest.mark.parametrize("there", ["c.toml", "c.npz"])
def test_a_calibration_replaces_neither_of_its_files_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: str, there: str
) -> None:
    (tmp_path / there).write_bytes(b"of before")
    assert main(["calibrate", "x.dng", "--mask", "mask-2", "-o", str(tmp_path / given)]) == 1
    assert f"{there} exists already: " in capsys.readouterr().err
    assert (tmp_path / there).read_bytes() == b"of before"


@pytest.mark.parametrize(("kind", "words"), [("npz", "--overwrite replaces it"), ("mat", "move it away")])
def test_an_export_is_refused_with_a_remedy_that_works(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, words: str
) -> None:
    out = tmp_path / "out.npz"
    out.touch()
    assert main(["export", "x.zarr", "--as", kind, "-o", str(out)]) == 1
    assert words in capsys.readouterr().err
    if kind == "mat":
        assert main(["export", "x.zarr", "--as", kind, "-o", str(tmp_path / "new.mat"), "--overwrite"]) == 1
        assert "remove what is there yourself" in capsys.readouterr().err


@pytest.mark.slow  # it loads every verb
def test_every_verb_with_a_named_output_can_be_told_to_replace_it() -> None:
    missing = set()
    for verb in VERBS:
        for words, options in completion.words(verb, completion.below(parser(verb))[verb]).items():
            if {"--output", "--picture", "--index"} & set(options) and "--overwrite" not in options:
                missing.add(words.replace("/", " "))
    assert missing - FOLDERS == set()
