"""Where the vehicle is and what the camera sees of the ground, for photographs by distance."""

from __future__ import annotations

from dappled.config.settings import TriggerSettings
from dappled.daemon.camera_protocol.camera_status import ReportedCamera
from dappled.daemon.navigation import Navigation
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.spacing import Height, Spacing
from dappled.decode.geometry import Pose


class LiveSurvey:
    """The SurveyFacts of a live flight. The height is the rangefinder's, or else that above the take-off place."""

    def __init__(self, navigation: Navigation, camera: ReportedCamera, shots: PendingShots) -> None:
        self._navigation, self._camera, self._shots = navigation, camera, shots

    def pose(self) -> Pose | None:
        """See SurveyFacts."""
        return self._navigation.pose_now()

    def height(self) -> Height | None:
        """See SurveyFacts."""
        measured = self._navigation.rangefinder.range()
        if measured is not None:
            return Height(measured.metres, "rangefinder")
        above_m = self._navigation.pose_now().height_above_home_m
        return None if above_m is None else Height(above_m, "above the take-off place")

    def field(self) -> tuple[float, float] | None:
        """See SurveyFacts."""
        facts = self._camera.facts()
        if not (facts.focal_length_mm and facts.sensor_height_mm and facts.sensor_width_mm):
            return None
        return facts.sensor_height_mm / facts.focal_length_mm, facts.sensor_width_mm / facts.focal_length_mm

    def busy(self) -> bool:
        """See SurveyFacts."""
        return self._shots.state == "busy" or self._shots.waits


def spacing_of(settings: TriggerSettings) -> Spacing | None:
    """The series of the settings; None where they have none."""
    if not settings.distance_m and not settings.overlap:
        return None
    return Spacing(settings.distance_m, settings.overlap)
