"""Frames by name, by folder and by flight; what is there is not replaced unasked."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from dappled.cli import decode_arguments, parser
from dappled.cli.arguments import OutputExistsError, refuse_existing
from dappled.errors import DappledError

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
    for name in ("000001.cr2", "000000.cr2", "000000.jpg", "000000.cr2.xmp"):
        (flight / "frames" / name).touch()
    for name in ("B.RAF", "A.dng", "notes.txt"):
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
