"""What the camera asks of its autopilot: the telemetry that poses need, and the time."""

from __future__ import annotations

from collections.abc import Iterator

from dappled.drivers.mavlink import Message, mavlink

TIMESYNC_NS = 200_000_000
STREAMS_NS = 5 * 10**9
STREAMS = (  # message, interval in microseconds
    (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 20_000),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 20_000),
    (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 200_000),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1_000_000),
)
_WANTED = frozenset(message_id for message_id, _ in STREAMS)


class AutopilotRequests:
    """Asks for the time at 5 Hz and, every five seconds, for each stream that came at less than half its rate."""

    def __init__(self) -> None:
        self._heard: dict[int, int] = {}
        self._time_due_ns = self._streams_due_ns = 0

    def heard(self, message_id: int) -> None:
        """A message of our autopilot came in."""
        if message_id in _WANTED:
            self._heard[message_id] = self._heard.get(message_id, 0) + 1

    def due(self, system: int, now_ns: int, utc_ns: int) -> Iterator[Message]:
        """What is to be sent to it by now."""
        if now_ns >= self._time_due_ns:
            self._time_due_ns = now_ns + TIMESYNC_NS
            yield mavlink.MAVLink_timesync_message(0, utc_ns)
        if now_ns >= self._streams_due_ns:
            self._streams_due_ns = now_ns + STREAMS_NS
            heard, self._heard = self._heard, {}
            for message_id, interval_us in STREAMS:
                if heard.get(message_id, 0) < STREAMS_NS / (interval_us * 1e3) / 2:
                    yield mavlink.MAVLink_command_long_message(
                        system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, interval_us, 0, 0, 0, 0, 0
                    )
