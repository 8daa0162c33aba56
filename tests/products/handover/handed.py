"""The truth of a handed-over flight, as the simulator has it."""

from __future__ import annotations

import math

import numpy as np

from dappled.decode.array_types import Floats
from dappled.decode.geometry import camera_pose
from tests.products.flown import Flown

UNDULATION_M = -31.25
NAMES = ["000000", "000001"]


def true_world(flown: Flown) -> list[tuple[Floats, Floats]]:
    """(camera axes to east, north, up; centre) of each frame, from the first one's place: by the Earth's own axes."""
    poses = [truth.pose for truth in flown.truths]
    places, turns = [], []
    for pose in poses:
        assert pose is not None
        at = math.radians(pose.latitude_deg), math.radians(pose.longitude_deg)
        places.append(camera_pose.to_ecef(*at, pose.altitude_msl_m))
        turns.append(camera_pose.ned_to_ecef(*at) @ camera_pose.matrix_of(pose.attitude) @ camera_pose.NADIR)
    assert poses[0] is not None
    home = camera_pose.ned_to_ecef(math.radians(poses[0].latitude_deg), math.radians(poses[0].longitude_deg))
    to_enu = np.stack([home[:, 1], home[:, 0], -home[:, 2]])
    return [(to_enu @ turn, to_enu @ (place - places[0])) for turn, place in zip(turns, places, strict=True)]


def close(turn: Floats, centre: Floats, true: tuple[Floats, Floats]) -> None:
    """Within 1 mm and 0.001°."""
    assert np.linalg.norm(centre - true[1]) < 1e-3
    assert np.linalg.norm(turn - true[0]) / math.sqrt(2) < math.radians(0.001)
