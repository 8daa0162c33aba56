"""`dappled trigger`: ask for photographs over MAVLink, as a ground station does."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, flag, option
from dappled.config import settings
from dappled.errors import CallError

if not words_only:
    from dappled.cli.terminal import waiting_for
    from dappled.daemon.camera_protocol.ground_client import GroundClient, Outcome
    from dappled.daemon.pipeline.spacing import MOST_M
    from dappled.drivers.mavlink import LinkError, parse

DEFAULT_URL = "udpout:127.0.0.1:14550"
_CALLED_AT = {"udpin": "udpout", "tcpin": "tcp"}


@dataclass(frozen=True, slots=True)
class Distance:
    """What --distance asks for: metres, 0 for an end; None: as the camera's settings say."""

    metres: float | None

    def __str__(self) -> str:
        return "settings" if self.metres is None else f"{self.metres:g}"

    @property
    def told(self) -> str:
        if self.metres is None:
            return "photographs by the camera's own settings: they go on until --distance off"
        return f"a photograph every {self.metres:g} m, until --distance off" if self.metres else "no more photographs"


def _distance(text: str) -> Distance:
    if text in ("settings", "off"):
        return Distance(None if text == "settings" else 0.0)
    try:
        metres = float(text)
    except ValueError:
        metres = math.nan
    if not 0 < metres <= MOST_M:
        raise ValueError(f"{text!r} is neither a distance of up to {MOST_M:g} m, nor settings, nor off")
    return Distance(metres)


@dataclass(frozen=True, kw_only=True)
class AskForPhotographs(Verb):
    """Ask for photographs."""

    examples = ("dappled trigger --url udpout:127.0.0.1:14550 --count 3 --interval 2",)

    url: str | None = option(
        "--url", "pymavlink connection string", None, metavar="URL", otherwise=DEFAULT_URL, alone="where",
    )  # fmt: skip
    config: Path | None = option("--config", "the daemon's settings file, which names its link", None, alone="where")
    distance: Distance | None = option(
        "--distance", "have the camera take a photograph every M metres over ground; settings: as its settings say, "
        "by distance or overlap; off: no more", None, parse=_distance, metavar="M",
    )  # fmt: skip
    count: int = option("--count", "number of photographs", 1, low=1)
    interval: float = option("--interval", "least time between them", 0.0, unit="s", low=0)
    timeout: float = option(
        "--timeout", "how long to wait for the camera, and for each photograph", 60.0, unit="s", low=0,
    )  # fmt: skip
    key: Path | None = option("--key", "the link's signing key (dappled mavlink key)", None)
    json: bool = flag("--json", "print one JSON object per photograph")

    def check(self) -> None:
        try:
            parse(self.url or DEFAULT_URL)
        except LinkError as error:
            raise CallError(str(error)) from None

    def run(self, output: Output) -> Report:
        url, key = self._link()
        with GroundClient(url, key_file=key) as client:
            with waiting_for(f"a camera on {url}"):
                client.find_camera(self.timeout)
            if self.distance is not None:
                client.by_distance(self.distance.metres)
                return Report({"distance": str(self.distance)}, [self.distance.told])
            outcomes = client.capture(
                self.count,
                self.interval,
                timeout_s=self.timeout,
                on_outcome=lambda one: output.row(_values(one), _line(one)),
            )
        return Report(failed=not all(one.ok for one in outcomes))

    def _link(self) -> tuple[str, Path | None]:
        """The url to call at, and its key. Raises LinkError where the settings name no link that can be called."""
        if self.config is None:
            return self.url or DEFAULT_URL, self.key
        mavlink = settings.load(self.config).mavlink
        for number, url in enumerate(mavlink.url):
            at = parse(url)
            if at.kind in _CALLED_AT:
                key = mavlink.link_keys[number]
                host = "127.0.0.1" if at.host == "0.0.0.0" else at.host  # noqa: S104  # nothing is bound to it here
                return f"{_CALLED_AT[at.kind]}:{host}:{at.port}", self.key or (Path(key) if key else None)
        raise LinkError(
            f"{self.config} names no link that listens: a ground station reaches the daemon by udpin: or tcpin: in "
            "mavlink.url, or on the autopilot's network; give --url"
        )


def _line(one: Outcome) -> str:
    ack = "" if one.ack_ms is None else f", acknowledged after {one.ack_ms:.1f} ms"
    if one.ok:
        return f"image {one.index}{ack}"
    return f"no image: {one.reason}{ack}"


def _values(one: Outcome) -> dict[str, Any]:
    return {"index": one.index, "ok": one.ok, "reason": one.reason, "ack_ms": one.ack_ms}
