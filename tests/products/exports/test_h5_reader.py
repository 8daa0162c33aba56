"""HDF5 files that the library does not survive are refused in a sentence."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from dappled.drivers.reader_process import Budget
from dappled.errors import DappledError
from dappled.products.exports import h5_reader
from dappled.products.exports.light_files import load, save
from tests.products.exports.test_light_files import light_field


@pytest.fixture
def h5(tmp_path: Path) -> Path:
    path = tmp_path / "a.h5"
    save(path, light_field())
    return path


def test_arrays_come_back_and_may_be_written_to(h5: Path) -> None:
    found = load(h5)
    before = found.slices.copy()
    found.slices[0] = 0
    np.testing.assert_array_equal(load(h5).slices, before)


@pytest.mark.parametrize(
    ("program", "words"),
    [("sleep 60", "did not come to an end with it"), ("kill -SEGV $$", "failed on it"), ("exit 1", "failed on it")],
)
def test_a_library_that_hangs_or_crashes_is_a_sentence(
    h5: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, words: str
) -> None:
    other = tmp_path / "python"
    other.write_text(f"#!/bin/sh\nexec sh -c '{program}'\n")
    other.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(other))
    monkeypatch.setattr(h5_reader, "_BUDGET", Budget(20e6, patience_s=0.5))
    with pytest.raises(DappledError, match=words) as caught:
        load(h5)
    assert str(h5) in str(caught.value)
