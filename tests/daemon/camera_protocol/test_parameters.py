"""Settings by name: each change is answered, whatever comes in between; and the definition file describes them."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as Xml

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import SystemClock
from dappled.daemon.camera_protocol.parameters import (
    TYPE,
    WAIT_NS,
    Parameter,
    Parameters,
    ParameterServer,
    camera_definition,
    code,
)
from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.mavlink import MavlinkMessage, Signing, make_key, mavlink, open_signing, read_key
from dappled.drivers.mavlink.signature_book import UNITS_PER_S
from dappled.drivers.mavlink.signing import EPOCH_UNIX_S
from tests.daemon.camera_protocol.rig import Camera, Peer


class Body:
    """A body that never takes a change. `meanwhile` happens once, the next time that its settings are looked at."""

    def __init__(self) -> None:
        self.meanwhile: Callable[[], object] | None = None

    def settings(self) -> tuple[Setting, ...]:
        now, self.meanwhile = self.meanwhile, None
        if now is not None:
            now()
        return (Setting("iso", "100", ("100", "200", "400")),)

    def change(self, name: SettingName, value: str) -> None:
        """Asked, and deaf."""


def wanted(value: str) -> MavlinkMessage:
    """A PARAM_EXT_SET as it is received."""
    data = struct.pack("<I", code(value)).ljust(128, b"\0")
    sent = mavlink.MAVLink_param_ext_set_message(1, 100, b"CAM_ISO", data, TYPE)
    return mavlink.MAVLink(None).decode(bytearray(sent.pack(mavlink.MAVLink(None))))


def results(replies: list[MavlinkMessage]) -> list[int]:
    return [message.param_result for message in replies]


def test_a_value_asked_for_while_another_one_runs_out_is_answered_too() -> None:
    body = Body()
    server = ParameterServer(Parameters(body))
    first = server.set(wanted("200"), 0, 0)
    assert results(list(first.messages)) == [mavlink.PARAM_ACK_IN_PROGRESS]
    body.meanwhile = lambda: server.set(wanted("400"), 1, WAIT_NS)
    assert server.settled(WAIT_NS) == []  # 200 has given way to 400, which is on its way
    ((link, reply),) = server.settled(2 * WAIT_NS)
    assert (link, results(list(reply.messages))) == (1, [mavlink.PARAM_ACK_FAILED])
    assert server.settled(3 * WAIT_NS) == []


def test_how_it_ended_is_told_once_though_two_threads_look() -> None:
    body = Body()
    server = ParameterServer(Parameters(body))
    server.set(wanted("200"), 0, 0)
    told: list[object] = []
    body.meanwhile = lambda: told.extend(server.settled(WAIT_NS))
    told.extend(server.settled(WAIT_NS))
    assert len(told) == 1


ISO = Parameter("CAM_ISO", "ISO", "100", ("Auto", "100", "200"))
APERTURE = Parameter("CAM_APERTURE", "Aperture", "5.6")


def test_it_names_every_setting_with_its_choices() -> None:
    made = camera_definition("Canon", "EOS <450D>", [ISO, APERTURE])
    root = Xml.fromstring(made.xml)  # noqa: S314  # our own bytes
    assert root.findtext("definition/model") == "EOS <450D>"
    assert root.find("definition").get("version") == str(made.version)  # type: ignore[union-attr]  # it is there
    iso, aperture = root.findall("parameters/parameter")
    assert [(one.get("name"), int(one.get("value", ""))) for one in iso.iter("option")] == [
        ("Auto", code("Auto")), ("100", 100), ("200", 200)
    ]  # fmt: skip
    assert (iso.get("readonly"), aperture.get("readonly")) == (None, "1")
    assert made.uri(100) == "mftp://[;comp=100]/camera.xml"


def test_the_version_follows_the_content_and_not_the_value_of_now() -> None:
    base = camera_definition("a", "b", [ISO]).version
    assert camera_definition("a", "b", [Parameter("CAM_ISO", "ISO", "200", ISO.choices)]).version == base
    assert camera_definition("a", "b", [Parameter("CAM_ISO", "ISO", "100", ("100", "200"))]).version != base
    assert camera_definition("a", "c", [ISO]).version != base


@given(st.text(max_size=20))
def test_any_words_make_sound_xml_and_a_number_that_fits(words: str) -> None:
    printable = "".join(c for c in words if c.isprintable())
    Xml.fromstring(camera_definition(printable, printable, [Parameter("X", printable, printable, (printable,))]).xml)  # noqa: S314  # our own bytes
    assert 0 <= code(words) < 2**31


EVERYWHERE = "0.0.0.0"  # noqa: S104  # a link that other machines reach


class Own:
    """A setting of dappled itself, and what it was set to."""

    def __init__(self) -> None:
        self.mask = "octave"

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("LF_MASK", "Mask", self.mask, ("octave", "none")),)

    def set(self, name: str, value: str) -> None:
        assert name == "LF_MASK"
        self.mask = value


class Decodable(Camera):
    """A camera with a mask that a ground station may change."""

    def __init__(self, url: str, *, unsigned: bool, signing: Signing | None = None) -> None:
        self.own = Own()
        super().__init__(
            urls=[url], signing=signing, settable=lambda camera: Parameters(camera, (self.own,), unsigned=unsigned)
        )


def set_mask(camera: Decodable, peer: Peer) -> int:
    data = struct.pack("<I", code("none")).ljust(128, b"\0")
    peer.send(mavlink.MAVLink_param_ext_set_message(1, 100, b"LF_MASK", data, TYPE))
    result = int(peer.one("PARAM_EXT_ACK").param_result)
    assert (camera.own.mask == "none") == (result == mavlink.PARAM_ACK_ACCEPTED)
    return result


@pytest.mark.parametrize(
    ("host", "unsigned", "taken"), [("", False, False), ("", True, True), ("127.0.0.1", False, True)]
)
def test_a_stranger_cannot_change_the_mask_over_an_unsigned_link(host: str, unsigned: bool, taken: bool) -> None:
    camera = Decodable(f"udpin:{host or EVERYWHERE}:0", unsigned=unsigned)
    with camera, Peer(camera.links.port(0)) as stranger:
        result = set_mask(camera, stranger)
        assert result == (mavlink.PARAM_ACK_ACCEPTED if taken else mavlink.PARAM_ACK_FAILED)
        if not taken:
            assert "LF_MASK" in stranger.one("STATUSTEXT").text


def test_a_station_with_the_key_sets_the_mask(tmp_path: Path) -> None:
    make_key(tmp_path / "key")
    signing = open_signing([tmp_path / "key"], tmp_path / "time", SystemClock())
    camera = Decodable(f"udpin:{EVERYWHERE}:0", unsigned=False, signing=signing)
    with camera, Peer(camera.links.port(0)) as station:
        station.packer.signing.secret_key, station.packer.signing.sign_outgoing = read_key(tmp_path / "key"), True
        station.packer.signing.timestamp = round((time.time() - EPOCH_UNIX_S) * UNITS_PER_S)
        assert set_mask(camera, station) == mavlink.PARAM_ACK_ACCEPTED
