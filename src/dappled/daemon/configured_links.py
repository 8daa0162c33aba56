"""Make the MAVLink links that the settings name."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from dappled.clock import Clock
from dappled.config.schema import ConfigError
from dappled.config.settings import Settings
from dappled.drivers.mavlink import MavlinkLinks, Transport, Unsigned, open_signing

SIGNING_TIME_FILE = ".mavlink-signing"


def configured_links(
    settings: Settings, clock: Clock, transport: Transport | None = None, *, times: Path | None = None
) -> MavlinkLinks:
    """All MAVLink links of the settings, not open yet. Without a `transport`: over the machine's sockets. `times` is
    the folder of the signing times, where it is not that of the flights.

    Raises ConfigError, LinkError, SigningError."""
    wanted, times = settings.mavlink, times or Path(settings.record.directory)
    return MavlinkLinks(
        wanted.url,
        system_id=wanted.system_id,
        component_id=wanted.component_id,
        clock=clock,
        signing=open_signing(key_files(settings), times / SIGNING_TIME_FILE, clock, cast(Unsigned, wanted.unsigned)),
        transport=transport,
    )


def key_files(settings: Settings) -> list[Path | None]:
    """The key file of each link, None for a link without one. Raises ConfigError where they are too few or too many."""
    keys, links = settings.mavlink.keys, len(settings.mavlink.url)
    if len(keys) not in (0, 1, links):
        raise ConfigError(
            f'mavlink.keys names {len(keys)} files for {links} links; name one for each link ("" for none), or one'
        )
    return [Path(key) if key else None for key in settings.mavlink.link_keys]
