"""`camera.driver = "simulated"`: its options."""

from __future__ import annotations

import pytest

from dappled.drivers.camera import CameraError
from dappled.mocks import simulated


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seed": "one"}, "camera.options: seed must be a whole number, not 'one'"),
        ({"seed": -1}, "seed = -1 must lie between 0"),
        ({"scale": 0}, "scale = 0.0 must lie between 0.01 and 4"),
        ({"law": "fish"}, "law = 'fish' must be one of geometric, fd"),
        ({"folder": 7}, "folder must be text, not 7"),
        ({"f_numbr": 8}, "f_numbr"),
    ],
)
def test_a_wrong_option_is_named_with_what_it_may_be(options: dict[str, object], words: str) -> None:
    with pytest.raises(CameraError, match=words):
        simulated.open_camera(options)
