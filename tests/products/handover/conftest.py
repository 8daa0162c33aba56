"""A flight in all forms, which several tests of this room share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dappled.products.batch import batch
from dappled.products.geotags import geotags
from dappled.products.handover import FORMS, forms
from dappled.products.maps.earth import Geoid
from dappled.products.maps.georeference import Options
from dappled.products.mounting import Mounting
from tests import shared
from tests.products.flown import Flown
from tests.products.handover.handed import NAMES, UNDULATION_M


@pytest.fixture(scope="session")
def handed(short_flight: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the flight in all forms, each frame decoded once. Not to be written to."""
    folder = shared.folder_of_run(tmp_path_factory)
    return shared.once(folder, "forms", lambda: _in_all_forms(short_flight, folder / "forms"))


def _in_all_forms(short_flight: Flown, output: Path) -> Path:
    kinds = [*FORMS] if _has("mcap_ros2") else [form for form in FORMS if form != "mcap"]
    placed, _ = geotags.read(short_flight.folder, geotags.PlacedBy(Mounting(), Geoid(offset_m=UNDULATION_M)))
    by_index = {one.frame.index: replace(one, utc_ns=one.tag.utc_ns) for one in placed}
    jobs = batch.plan(short_flight.folder, short_flight.recipe, Options(view="ground"), kinds, output, placed=by_index)
    assert [batch.make(job).error for job in jobs] == [None, None]
    folder = output / short_flight.folder.name
    for kind in kinds:
        for path in forms.finish(kind, folder / kind, short_flight.folder.name, NAMES):
            assert path.is_file()
    return folder


def _has(module: str) -> bool:
    try:
        __import__(module)
    except ImportError:
        return False
    return True
