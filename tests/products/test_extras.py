"""What a person reads where a library of the ground extra is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from dappled.products.extras import MissingExtraError, need


def test_a_missing_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)  # Python's own way to say: not there
    with pytest.raises(MissingExtraError, match=r"opencv-python-headless; .*'dappled\[ground\]'"):
        need("cv2")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"'dappled\[cluster\]'"):
        need("distributed")
    assert need("json").dumps([]) == "[]"


def test_a_library_that_cannot_be_loaded_is_not_called_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> None:
        raise ImportError("libxcb.so.1: cannot open shared object file", name=name)

    monkeypatch.setattr("dappled.products.extras.importlib.import_module", broken)
    with pytest.raises(MissingExtraError, match=r"opencv-python-headless is installed but can't be loaded: libxcb"):
        need("cv2")


def test_maps_can_be_imported_without_the_extras() -> None:
    code = (
        "import sys\n"
        "for name in ('cv2', 'rasterio', 'laspy', 'h5py', 'distributed', 'rerun'): sys.modules[name] = None\n"
        "import dappled.cli.georeference, dappled.cli.batch\n"
        "import dappled.products.maps.refine, dappled.products.chessboard\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
