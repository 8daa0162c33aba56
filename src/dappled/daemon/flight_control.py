"""Tell the shutter and the ground station about the flight: whether a shot may be taken, the camera, the disk."""

from __future__ import annotations

from dappled.daemon.camera_protocol import camera_status
from dappled.daemon.camera_protocol.camera_status import CameraFacts, Captured, ReportedCamera
from dappled.daemon.camera_protocol.parameters import Parameter
from dappled.daemon.flight_handover import FlightHandover
from dappled.daemon.health import resources
from dappled.daemon.health.status_text import Alarms
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.navigation import Navigation
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.decode.geometry import Pose
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import FlightError, Shot, layout
from dappled.flight.layout import DiskSpace
from dappled.flight.records import LOST, REFUSED

LOOK_VALID_NS = 5 * 10**9


class FlightControl:
    """The ShotSink and the CameraModel of one live flight.

    `handover` takes what the next flight is flown with; None: there is none.
    """

    def __init__(
        self,
        settings: LiveSettings,
        shots: PendingShots,
        writer: LedgerWriter,
        navigation: Navigation,
        *,
        camera: ReportedCamera,
        alarms: Alarms,
        handover: FlightHandover | None,
    ) -> None:
        self._settings, self._clock, self._shots = settings, shots.clock, shots
        self._writer, self._recording = writer, writer.recording
        self._navigation, self._camera = navigation, camera
        self._alarms, self._handover = alarms, handover
        self.lost_triggers = 0
        self._looked: tuple[Finding | None, int] = (None, 0)

    # ShotSink

    def obstacle(self) -> Finding | None:
        if self._handover is not None and self._handover.next is not None:
            return finding(Code.FLIGHT_NEXT_BEGINS, Subject("flight"))
        if (missing := self._shots.without_camera()) is not None:
            return missing
        try:
            space = layout.disk_space(self._recording.folder.path)
        except FlightError as error:
            return finding(Code.DISK_UNREADABLE, Subject("disk"), why=error)
        return space.shortage(self._settings.now.record.min_free_mb) or self.shortage

    @property
    def shortage(self) -> Finding | None:
        """Why descriptors or memory don't suffice, as `look` found it; None where it is older than five seconds."""
        found, at_ns = self._looked
        return found if self._clock.monotonic_ns() - at_ns <= LOOK_VALID_NS else None

    def look(self) -> None:
        """See what this machine has left. The working loop calls this, so that no command waits for it."""
        self._looked = resources.shortage(resources.look()), self._clock.monotonic_ns()

    def note(self, shot: Shot) -> None:
        """Write a shot down before the camera is touched."""
        self._recording.journal.note(shot)

    def fire(self, shot: Shot) -> None:
        self._shots.fire(shot)

    def refused(self, why: Finding) -> None:
        """Requests became no shots: the first of a source for a reason, later how many more."""
        self._writer.later(REFUSED, why)

    # CameraModel

    @property
    def mount(self) -> tuple[float, ...]:
        """The rotation from camera to body axes, row by row, as it may be changed in flight."""
        return self._settings.now.pose.mount

    @property
    def on_gimbal(self) -> bool:
        """Whether the camera hangs on the gimbal, to whose head the mount leads then."""
        return self._settings.now.pose.on_gimbal

    def facts(self) -> CameraFacts:
        return self._camera.facts()

    def storage(self) -> DiskSpace | None:
        try:
            return layout.disk_space(self._recording.folder.path)
        except FlightError:
            return None

    def lookup(self, index: int) -> Captured | None:
        """How an old shot ended; None for one that never was."""
        if self._shots.untagged(index):
            return None  # its own message will come
        return camera_status.captured_image(index, self._recording.index)

    def pose(self) -> Pose | None:
        return self._navigation.pose_now()

    def troubled(self) -> bool:
        return self._alarms.troubled

    def lost(self, triggers: Finding) -> None:
        self.lost_triggers += triggers.number("triggers")
        self._writer.later(LOST, triggers)


class DecodingParameter:
    """LF_DECODE: decode in flight, or leave it to the ground. Read-only where a flight `decodes` nothing."""

    def __init__(self, shots: PendingShots, writer: LedgerWriter, *, decodes: bool) -> None:
        self._shots, self._writer, self._decodes = shots, writer, decodes

    def parameters(self) -> tuple[Parameter]:
        choices = ("on", "off") if self._decodes else ()
        return (Parameter("LF_DECODE", "Decode in flight", "on" if self._shots.decoding else "off", choices),)

    def set(self, name: str, value: str) -> None:
        """Take one of the choices of one of them; it has it at once."""
        self._shots.decoding = value == "on"
        self._writer.later("decoding", finding(Code.DECODE_SWITCHED, Subject("decoding"), value=value))
