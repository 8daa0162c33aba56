"""MAVLink links: packets in and out over UDP, TCP and serial, logged, and signed where there is a key.

`links` receives and sends packets, `channels` opens connections, `peers` says who is sent what, `framing` cuts bytes
into packets, `signing` signs and verifies.
"""

from dappled.drivers.mavlink.channels import LinkError, Transport, parse
from dappled.drivers.mavlink.framing import Framed, MavlinkMessage, PacketParser, is_for, mavlink, pack
from dappled.drivers.mavlink.links import LinkStatistics, MavlinkLinks, Packet, PacketLog, PacketReceiver, PacketSender
from dappled.drivers.mavlink.signing import (
    Signing,
    SigningError,
    SigningStatistics,
    Unsigned,
    make_key,
    open_signing,
    read_key,
)

__all__ = [
    "Framed",
    "LinkError",
    "LinkStatistics",
    "MavlinkLinks",
    "MavlinkMessage",
    "Packet",
    "PacketLog",
    "PacketParser",
    "PacketReceiver",
    "PacketSender",
    "Signing",
    "SigningError",
    "SigningStatistics",
    "Transport",
    "Unsigned",
    "is_for",
    "make_key",
    "mavlink",
    "open_signing",
    "pack",
    "parse",
    "read_key",
]
