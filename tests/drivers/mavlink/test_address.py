"""Connection strings as pymavlink's users write them."""

from __future__ import annotations

import pytest

from dappled.drivers.mavlink.address import Address, LinkError, parse


@pytest.mark.parametrize(
    ("url", "kind", "host", "port"),
    [
        ("udpin:192.0.2.1:14550", "udpin", "192.0.2.1", 14550),
        ("udp:127.0.0.1:14550", "udpin", "127.0.0.1", 14550),
        ("127.0.0.1:14550", "udpin", "127.0.0.1", 14550),
        ("udpout:drone.local:14551", "udpout", "drone.local", 14551),
        ("tcp:10.0.0.1:5760", "tcp", "10.0.0.1", 5760),
        ("tcpin:192.0.2.1:5760", "tcpin", "192.0.2.1", 5760),
        ("/dev/ttyAMA0", "serial", "/dev/ttyAMA0", 115200),
        ("/dev/ttyUSB0,57600", "serial", "/dev/ttyUSB0", 57600),
        ("serial:/dev/ttyUSB0:921600", "serial", "/dev/ttyUSB0", 921600),
    ],
)
def test_forms(url: str, kind: str, host: str, port: int) -> None:
    assert parse(url) == Address(url, kind, host, port)  # type: ignore[arg-type]  # kinds come as plain text here


@pytest.mark.parametrize(
    "url",
    ["", "udpin:", "udpin:127.0.0.1", "udpin:127.0.0.1:x", "udpout:h:0", "tcp:h:70000", "COM3", "serial:x", "/d,x"],
)
def test_a_malformed_url_is_named_in_the_sentence(url: str) -> None:
    with pytest.raises(LinkError, match=r"mavlink\.url"):
        parse(url)
