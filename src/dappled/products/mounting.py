"""How the camera is mounted on the vehicle, and the camera's pose that follows from the vehicle's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dappled import codec
from dappled.codec import CodecError
from dappled.decode.geometry import Pose, Vector3, camera_pose
from dappled.decode.geometry.camera_pose import CameraPose, Matrix
from dappled.errors import DappledError


@dataclass(frozen=True, slots=True)
class Mounting:
    """The lever arm from antenna to camera (m: forward, right, down) and the rotation from camera axes to body axes.

    `mount` holds the rotation row by row. With `on_gimbal` it leads to the axes of the gimbal's head instead, and the
    gimbal's recorded attitude is used.
    """

    lever_m: Vector3 = (0.0, 0.0, 0.0)
    mount: tuple[float, ...] = tuple(camera_pose.NADIR.ravel().tolist())
    on_gimbal: bool = False

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Mounting:
        """The mounting in a flight's facts: its settings `pose.lever_arm_m`, `pose.mount` and `pose.on_gimbal`. Raises
        DappledError for other ones."""
        given, default = facts.get("settings", {}).get("pose", {}), cls()
        try:
            return cls(
                codec.read(tuple[float, float, float], given.get("lever_arm_m") or default.lever_m),
                codec.read(tuple[float, ...], given.get("mount") or default.mount),
                codec.read(bool, given.get("on_gimbal", False)),
            )
        except CodecError as error:
            raise DappledError(f"the flight's settings of [pose] are damaged: a mounting {error}") from None

    @property
    def matrix(self) -> Matrix:
        """(3, 3), camera to body axes. Raises DappledError where `mount` is not a rotation."""
        return camera_pose.mount(self.mount)

    def camera(self, pose: Pose, undulation_m: float | None = None) -> CameraPose | None:
        """The camera's pose; None where the vehicle's position is not known.

        `undulation_m` is the ellipsoidal height of mean sea level there, if known.
        """
        return camera_pose.of(pose, self.lever_m, self.matrix, on_gimbal=self.on_gimbal, undulation_m=undulation_m)
