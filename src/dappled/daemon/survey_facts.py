"""Where the vehicle is and what the camera sees of the ground, for photographs by distance."""

from __future__ import annotations

from dappled.clock import Clock
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.camera_status import ReportedCamera
from dappled.daemon.navigation import Navigation
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger, Height, Spacing
from dappled.decode.geometry import Pose


class LiveSurvey:
    """The SurveyFacts of a live flight. The height is the rangefinder's or the terrain's, or else that above the
    take-off place."""

    def __init__(self, navigation: Navigation, camera: ReportedCamera, shots: PendingShots) -> None:
        self._navigation, self._camera, self._shots = navigation, camera, shots

    def pose(self) -> Pose | None:
        return self._navigation.pose_now()

    def height(self) -> Height | None:
        return Height.of(self._navigation.pose_now())

    def field(self) -> tuple[float, float] | None:
        facts = self._camera.facts()
        if not (facts.focal_length_mm and facts.sensor_height_mm and facts.sensor_width_mm):
            return None
        return facts.sensor_height_mm / facts.focal_length_mm, facts.sensor_width_mm / facts.focal_length_mm

    def busy(self) -> bool:
        return self._shots.state == "busy" or self._shots.waits


def distance_trigger(shutter: Shutter, survey: LiveSurvey, clock: Clock, settings: Settings) -> DistanceTrigger:
    """The trigger by distance, with the series of the settings, if they have one."""
    wanted = settings.trigger
    return DistanceTrigger(
        shutter,
        survey,
        clock,
        mount=settings.pose.mount,
        configured=Spacing(wanted.distance_m, wanted.overlap) if wanted.distance_m or wanted.overlap else None,
        from_height_m=wanted.from_height_m,
    )
