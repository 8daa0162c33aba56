"""Flights that several tests of this room share, and views of their frames, which are made once."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator
from typing import Any

import pytest

from dappled.decode import decoder
from dappled.decode.joint import frame_views
from dappled.decode.joint.frame_views import FrameViews
from tests import shared
from tests.products import flown
from tests.products.flown import Flown


@pytest.fixture(scope="session")
def short_flight(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Two overlapping frames with true poses. Not to be written to."""
    folder = shared.folder_of_run(tmp_path_factory)
    return shared.once(folder, "short-flight", lambda: flown.fly(folder / "short-flight", times_s=(1.0, 1.7)))


@pytest.fixture(scope="session", autouse=True)
def views_made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The same slices, cut by the same recipe, get the views that they got before: tests of this room decode the same
    few frames some sixty times, and views are most of a decode. What views are like, tests of `decode` say."""
    folder = shared.folder_of_run(tmp_path_factory)

    def kept(*words: Any, **names: Any) -> FrameViews:
        names_that_count = {name: value for name, value in names.items() if name != "workers"}
        key = hashlib.sha256(pickle.dumps((words, sorted(names_that_count.items())), protocol=5)).hexdigest()
        return shared.once(folder, f"views-{key}", lambda: frame_views.views_of(*words, **names))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decoder, "views_of", kept)
        yield
