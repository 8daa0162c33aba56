"""Which system this camera belongs to: that of the only autopilot on its links."""

from __future__ import annotations

from dappled.drivers.mavlink.links import Message, mavlink

LISTEN_NS = 3 * 10**9
ALONE_NS = 1_200_000_000  # heartbeats come every second: a second autopilot would have shown by now


class Identity:
    """Decides three seconds after the start at the latest: the sole autopilot's system id, or, where there are several
    or none, the configured one. Decides sooner when one autopilot was heard alone for 1.2 s. Where there was none (it
    boots more slowly than this machine), the first that is later heard alone for 1.2 s is taken; then it stays."""

    def __init__(self, configured_system_id: int, start_ns: int) -> None:
        self.system_id = configured_system_id
        self.settled = False
        self.autopilots: dict[int, int] = {}  # system id: link it was last heard on
        self._nobody_yet = True
        self._start_ns = start_ns
        self._first_heard_ns: int | None = None

    def heard(self, message: Message, link: int, now_ns: int) -> None:
        """A HEARTBEAT came in. Times are monotonic."""
        if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID or message.type == mavlink.MAV_TYPE_GCS:
            return
        if len(self.autopilots) < 32 or message.get_srcSystem() in self.autopilots:
            self.autopilots[message.get_srcSystem()] = link
        if self._first_heard_ns is None:
            self._first_heard_ns = now_ns

    def decide(self, now_ns: int) -> bool:
        """Whether it is known by now who we are."""
        waited = self._first_heard_ns is not None and now_ns - self._first_heard_ns >= ALONE_NS
        if not self.settled and now_ns - self._start_ns >= LISTEN_NS:
            self.settled = waited = True
        if self._nobody_yet and self.autopilots and waited:
            self._nobody_yet = False
            heard = tuple(self.autopilots)  # as of now: another may be heard meanwhile
            if len(heard) == 1:
                self.settled = True
                self.system_id = heard[0]
        return self.settled

    def doubt(self) -> str | None:
        """A sentence where autopilots are heard, but not that of the system which the camera belongs to."""
        heard = sorted(self.autopilots)
        if not self.settled or self._nobody_yet or not heard or self.system_id in heard:
            return None
        ids = ", ".join(map(str, heard))
        who = f"autopilot {ids} is" if len(heard) == 1 else f"autopilots {ids} are"
        return f"{who} heard, the camera belongs to system {self.system_id}: set mavlink.system_id"

    def vehicle(self) -> int | None:
        """Whose telemetry counts: our own system's, once that is decided. None while no autopilot was heard, or only
        one of another system: its is better than none."""
        known = self.settled and (len(self.autopilots) > 1 or self.system_id in self.autopilots)
        return self.system_id if known else None

    def autopilot(self) -> tuple[int, int] | None:
        """(system id, link) of our own autopilot; None while it was not heard."""
        link = self.autopilots.get(self.system_id)
        return None if link is None else (self.system_id, link)
