"""Flights that several tests of this room share, and views of their frames, which are made once."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from dappled.decode import decoder
from dappled.decode.joint import frame_views
from dappled.decode.joint.frame_views import FrameViews, TakenSlices
from dappled.decode.picture import shadow_fit
from dappled.drivers.raw import picture_maker
from tests import shared
from tests.products import flown
from tests.products.flown import Flown

_quick = threading.Event()


@pytest.fixture(autouse=True)
def quick_views(request: pytest.FixtureRequest, views_made_once: None) -> Iterator[None]:
    """Default tests of this room say what is made of views, and not how good these are: each is an inverse of slices.
    Slow tests have those of the joint model, which takes seconds a frame."""
    if not request.node.get_closest_marker("slow"):
        _quick.set()
    yield
    _quick.clear()


@pytest.fixture(scope="session")
def short_flight(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Two overlapping frames with true poses. Not to be written to."""
    folder = shared.folder_of_run(tmp_path_factory)
    return shared.once(folder, "short-flight", lambda: flown.fly(folder / "short-flight", times_s=(1.0, 1.7)))


@pytest.fixture(scope="session", autouse=True)
def views_made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The same slices, cut by the same recipe, get the views that they got before, and a mosaic its shadow: tests of
    this room decode and develop the same few frames some sixty times, and these are most of that. What views and
    shadows are like, tests of `decode` say."""
    folder = shared.folder_of_run(tmp_path_factory)

    def once(make: Callable[..., Any], *given: Any) -> Any:
        key = hashlib.sha256(pickle.dumps((make.__name__, given), protocol=5)).hexdigest()
        return shared.once(folder, key, lambda: make(*given))

    def views(taken: TakenSlices, *, joint: bool, workers: int = 1) -> FrameViews:
        def views_of(taken: TakenSlices, joint: bool) -> FrameViews:
            return frame_views.views_of(taken, joint=joint, workers=workers)

        made: FrameViews = once(views_of, taken, joint and not _quick.is_set())
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decoder, "views_of", views)
        for make in (shadow_fit.told_by, shadow_fit.shadow_of):
            patch.setattr(picture_maker, make.__name__, partial(once, make))
        yield
