"""`dappled status`: show the state of the running daemon on one screen; find the daemon's endpoint on this machine."""

from __future__ import annotations

import os
import pwd
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, argument, flag, option
from dappled.config import settings
from dappled.daemon.health.go_no_go import state
from dappled.errors import DappledError
from dappled.findings import above_note, told

if not words_only:
    from dappled.daemon.health.record import four_numbers
    from dappled.daemon.health.standing import ALL_IS_WELL, in_record
    from dappled.daemon.stream import sockets
    from dappled.daemon.stream.subscriber import Subscriber
    from dappled.daemon.stream.wire import WireError

SERVICE_FOLDER = Path("/run/dappled")  # RuntimeDirectory= of systemd/dappled.service


def to_endpoint(text: str) -> str:
    """One that a stream may have. Raises ValueError."""
    if not re.fullmatch(r"ipc://.+|tcp://.+:\d+", text):
        raise ValueError(f"{text!r} is not a ZeroMQ endpoint such as ipc:///run/dappled/slices or tcp://HOST:PORT")
    return text


@dataclass(frozen=True, kw_only=True)
class ShowStatus(Verb):
    """Show the state of the daemon."""

    examples = ("dappled status --config /etc/dappled/dappled.toml",)

    endpoint: str | None = argument(
        "ENDPOINT", "ZeroMQ endpoint of the stream (default: from --config)", default=None, parse=to_endpoint
    )
    config: Path | None = option("--config", "the daemon's settings file", None, otherwise="the built-in settings")
    timeout: float = option("--timeout", "how long to wait for a record", 3.0, unit="s", low=0)
    json: bool = flag("--json", "print the health record as it is published")

    def run(self, output: Output) -> Report:
        record = health(self.endpoint or stream_endpoint(self.config), self.timeout, unit(self.config))
        return Report(record, screen(record))


def unit(config: Path | None) -> str:
    """The service that has these settings: those with another name beside the service's (/etc/dappled/left.toml) are
    of `dappled@left`."""
    if config is not None and config.absolute().parent.name == "dappled" and config.stem != "dappled":
        return f"dappled@{config.stem}"
    return "dappled"


def stream_endpoint(config: Path | None, service: Path | None = None) -> str:
    """Endpoint of the daemon on this machine: the one in the settings, else this user's own, else the service's.

    `service` is the service's folder (default: `SERVICE_FOLDER`). `dappled@left` (see `unit`) has a folder of its own,
    which goes before this user's own daemon: that may be of another camera. Raises ConfigError, and WireError if this
    user may not open the service's folder.
    """
    endpoint = settings.load(config).publish.slices
    ours = settings.runtime_folder() / "slices"
    service = service or SERVICE_FOLDER
    name = unit(config)
    one_of_several = name != "dappled"
    service = service.with_name(name.replace("dappled@", f"{service.name}-")) if one_of_several else service
    if endpoint != f"ipc://{ours}" or ours.parent == service or not service.is_dir():
        return endpoint
    if not one_of_several and is_listening(endpoint):
        return endpoint
    if not os.access(service, os.X_OK):
        raise WireError(
            f"{service}: only members of its group may ask the service: "
            "sudo usermod -aG dappled $USER, then log in again"
        )
    return f"ipc://{service}/slices"


def is_listening(endpoint: str) -> bool:
    """Whether a daemon listens on an ipc endpoint; False for any other endpoint."""
    return _listener(endpoint) is not None


def _listener(endpoint: str) -> int | None:
    """The user id of who listens on an ipc endpoint; None where nobody does, and for any other endpoint."""
    return sockets.listener(endpoint.removeprefix("ipc://")) if endpoint.startswith("ipc://") else None


def stranger(endpoint: str) -> str | None:
    """The user whose daemon listens on an ipc endpoint; None where it is this user's own, or can't be known."""
    user = _listener(endpoint)
    if user is None or user == os.getuid():
        return None
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)


def health(endpoint: str, timeout_s: float, name: str = "dappled") -> Mapping[str, Any]:
    """The daemon's next health record; `name` is its service's. Raises DappledError after `timeout_s`."""
    until = time.monotonic() + timeout_s
    with Subscriber(endpoint, topics=("health",)) as subscriber:
        while (left := until - time.monotonic()) > 0:
            message = subscriber.receive(left)
            if message is not None and message.topic == "health":
                return message.header
    raise DappledError(
        f"no daemon was heard on {endpoint} for {timeout_s:g} s: check that it runs (systemctl status {name}) "
        "with these settings (--config)"
    )


def screen(record: Mapping[str, Any]) -> list[str]:
    """The record in words, line by line."""
    camera, link, disk, shots = record["camera"], record["link"], record["disk"], record["shots"]
    free = "unknown" if disk["free_bytes"] is None else f"{disk['free_bytes'] / 1e9:.1f} GB free"
    reason = f": {camera['reason']}" if camera["reason"] else ""
    lines = [
        f"flight    {record['flight']}",
        f"camera    {camera['state']}{reason}",
        f"link      {link['urls']} open, {link['packets']} packets, {link['positions']} positions",
        *(f"          {_link(one)}" for one in link["each"]),
        f"disk      {free}, {disk['folder']}",
        f"shots     {', '.join(f'{count} {what}' for what, count in four_numbers(shots).items())}",
    ]
    for stage in record["stages"]:
        if "waiting" in stage:
            lines.append(f"{stage['name']:9} {_counts(stage, 'done', 'waiting', 'failed', 'dropped')}")
    found = in_record(record)
    lines.append(f"{state(found).upper() if above_note(found) else ALL_IS_WELL}")
    lines += [
        f"{one.level.word:9} {told(one)} [{one.code}]{_for(row)}"
        for one, row in zip(found, record["findings"], strict=True)
    ]
    return lines


def _for(row: Mapping[str, Any]) -> str:
    """Since when a finding stands."""
    age_s = row.get("age_s", 0)
    return "" if age_s < 60 else f" (for {age_s / 60:.0f} min)"


def _link(facts: Mapping[str, Any]) -> str:
    signing = facts["signing"]
    signed = ""
    if signing is not None:
        signed = f"; signed: {_counts(signing, 'good', 'forged', 'replayed', 'unsigned_taken', 'unsigned_refused')}"
    names = ("in", "out", "bad", "unsent", *(["unrecorded"] if facts.get("unrecorded") else []))
    return f"{facts['url']}: {_counts(facts, *names)}{signed}".replace("_", " ")


def _counts(facts: Mapping[str, Any], *names: str) -> str:
    return ", ".join(f"{facts[name]} {name}" for name in names)
