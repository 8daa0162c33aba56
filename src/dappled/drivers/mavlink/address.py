"""Connection strings, as pymavlink's users write them, and what is wrong with one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dappled.errors import DappledError

Kind = Literal["udpin", "udpout", "udpbcast", "tcp", "tcpin", "serial"]
FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, udpbcast:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or /dev/ttyX[,BAUD]"
DEFAULT_BAUD = 115200
_SCHEMES: dict[str, Kind] = {
    "udp": "udpin",
    "udpin": "udpin",
    "udpout": "udpout",
    "udpbcast": "udpbcast",
    "tcp": "tcp",
    "tcpin": "tcpin",
}


class LinkError(DappledError):
    """A link can't be had: one sentence with the url and what to do."""


@dataclass(frozen=True, slots=True)
class Address:
    """One parsed connection string. `port` is the UDP or TCP port, or the baud rate of a serial device."""

    url: str
    kind: Kind
    host: str
    port: int


def parse(url: str) -> Address:
    """`url` as an address. `udp:HOST:PORT` and `HOST:PORT` listen, as in pymavlink. Raises LinkError."""
    scheme, colon, rest = url.partition(":")
    if url.startswith("/") or scheme == "serial":
        return _serial(url, url if url.startswith("/") else rest)
    kind = _SCHEMES.get(scheme)
    if colon and kind is not None:
        return _socket(url, kind, rest)
    if url.count(":") == 1 and rest.isdigit():
        return _socket(url, "udpin", url)
    raise LinkError(f"mavlink.url {url!r} is not a connection string; write {FORMS}")


def _socket(url: str, kind: Kind, rest: str) -> Address:
    host, _, port = rest.rpartition(":")
    if not host or ":" in host:
        raise LinkError(f"mavlink.url {url!r} needs a host and a port, as in {kind}:127.0.0.1:14550")
    if not (port.isascii() and port.isdigit() and int(port) <= 65535):
        raise LinkError(f"mavlink.url {url!r}: {port!r} is not a port; write a number up to 65535")
    if kind not in ("udpin", "tcpin") and int(port) == 0:
        raise LinkError(f"mavlink.url {url!r}: port 0 is nobody's; name the port that the other side listens on")
    return Address(url, kind, host, int(port))


def _serial(url: str, rest: str) -> Address:
    device, separator, baud = rest.replace(":", ",").partition(",")
    if not device.startswith("/"):
        raise LinkError(f"mavlink.url {url!r} needs a device, as in /dev/ttyAMA0,921600")
    if separator and not (baud.isascii() and baud.isdigit()):
        raise LinkError(f"mavlink.url {url!r}: {baud!r} is not a baud rate; write a number such as {DEFAULT_BAUD}")
    return Address(url, "serial", device, int(baud) if separator else DEFAULT_BAUD)
