"""What the simulated bodies don't do: files without bytes, very long names; and which settings are read when."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gphoto2 as gp
import pytest

from dappled.drivers.gphoto2 import session as opening
from dappled.drivers.gphoto2.intake import Intake
from dappled.drivers.gphoto2.protocol import CameraFile, RefusedError, SettingTurned
from dappled.drivers.gphoto2.session import GPhoto2Session
from dappled.drivers.gphoto2.settings import parse_settings

FOLDER = "/store/DCIM/100CANON"


@dataclass
class Info:
    size: int
    fields: int = gp.GP_FILE_INFO_SIZE | gp.GP_FILE_INFO_MTIME
    mtime: int = 1_700_000_000


@dataclass
class Told:
    file: Info


@dataclass
class Widget:
    value: str
    choices: tuple[str, ...] = ()
    kind: int = gp.GP_WIDGET_RADIO
    readonly: int = 0

    def get_value(self) -> str:
        return self.value

    def get_type(self) -> int:
        return self.kind

    def get_readonly(self) -> int:
        return self.readonly

    def get_choices(self) -> tuple[str, ...]:
        return self.choices


@dataclass
class FakeLibrary:
    """The part of `gphoto2.Camera` that reading a file needs."""

    card: dict[str, bytes] = field(default_factory=dict)
    widgets: dict[str, Widget] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    coming: list[tuple[int, str]] = field(default_factory=list)

    def exit(self) -> None:
        """The session ends."""

    def get_single_config(self, name: str) -> Any:
        if name not in self.widgets:
            raise gp.GPhoto2Error(gp.GP_ERROR_BAD_PARAMETERS)
        self.asked.append(name)
        return self.widgets[name]

    def wait_for_event(self, _timeout_ms: int) -> tuple[int, Any]:
        return self.coming.pop(0) if self.coming else (gp.GP_EVENT_TIMEOUT, None)

    def file_get_info(self, folder: str, name: str) -> Told:
        return Told(Info(len(self.card[name])))

    def file_read(self, folder: str, name: str, kind: int, offset: int, into: memoryview) -> int:
        piece = self.card[name][offset : offset + len(into)]
        into[: len(piece)] = piece
        return len(piece)


@pytest.fixture
def library() -> FakeLibrary:
    return FakeLibrary()


@pytest.fixture
def session(library: FakeLibrary) -> GPhoto2Session:
    return GPhoto2Session(library, "usb:1,2", "card")


def test_a_file_without_bytes_is_refused_in_a_sentence(library: FakeLibrary, session: GPhoto2Session) -> None:
    library.card["IMG_0001.CR2"] = b""
    with pytest.raises(RefusedError, match=r"announced 0 bytes of IMG_0001\.CR2"):
        session.fetch(CameraFile(FOLDER, "IMG_0001.CR2"), Intake(), lambda: None)


@pytest.mark.parametrize("name", ["IMG_0001.CR2", "Ä" * 200 + ".CR2"])
def test_a_file_is_read_in_pieces_whatever_it_is_called(
    library: FakeLibrary, session: GPhoto2Session, name: str
) -> None:
    library.card[name] = bytes(range(256)) * 5000  # more than a piece
    told: list[int] = []
    fetched = session.fetch(CameraFile(FOLDER, name), Intake(), lambda: told.append(1))
    assert len(told) == 2  # each piece, so that a slow cable is not taken for a dead body
    assert os.pread(fetched.blob.fd, fetched.blob.size + 1, 0) == library.card[name]
    assert fetched.taken_s == 1_700_000_000
    fetched.blob.close()


CUSTOM = "d4,4,1,20,2,101,1,0,10f,1,0,3,2c,3,50e,1,0,511,1,0,60f,1,{},4,38,4,701,1,0,"


def test_what_changes_rarely_is_read_again_only_after_a_change(library: FakeLibrary, session: GPhoto2Session) -> None:
    library.widgets = {
        "iso": Widget("100", ("100", "200")),
        "autoexposuremode": Widget("Manual", ("Manual", "AV")),
        "autopoweroff": Widget("30", kind=gp.GP_WIDGET_TEXT),
        "customfuncex": Widget(CUSTOM.format(0), kind=gp.GP_WIDGET_TEXT),
    }
    read = {one.name: (one.value, one.choices) for one in session.settings()}
    assert read["auto_power_off"] == ("30", ("0", "30"))
    assert read["mirror_lockup"] == ("off", ())
    library.asked.clear()
    session.settings()
    assert library.asked == ["iso"]  # each read is a transaction that a shot would wait for
    told = 'PTP Property d105 changed, "autoexposuremode" to "{}"'
    library.coming = [(gp.GP_EVENT_UNKNOWN, told.format("Manual"))]  # reading it makes such an event
    assert session.news() == []
    library.coming = [(gp.GP_EVENT_UNKNOWN, told.format("AV")), (gp.GP_EVENT_UNKNOWN, told.format("AV"))]
    library.widgets["autoexposuremode"] = Widget("AV", ("Manual", "AV"))
    assert session.news() == [SettingTurned()]
    assert ("exposure_mode", "AV") in [(one.name, one.value) for one in session.settings()]


@pytest.mark.parametrize("readonly", [0, 1])
def test_what_the_body_holds_fast_offers_no_choice(
    library: FakeLibrary, session: GPhoto2Session, readonly: int
) -> None:
    library.widgets = {
        "iso": Widget("100", ("100", "200"), readonly=readonly),
        "autopoweroff": Widget("30", kind=gp.GP_WIDGET_TEXT, readonly=readonly),
    }
    choices = {one.name: one.choices for one in session.settings()}
    offered = {"iso": ("100", "200"), "auto_power_off": ("0", "30")}
    assert choices == (dict.fromkeys(offered, ()) if readonly else offered)


@pytest.mark.parametrize(("text", "value"), [(CUSTOM.format(1), "on"), (CUSTOM.format(0), "off"), ("bad length", None)])
def test_mirror_lock_up_is_one_of_canon_s_custom_functions(
    library: FakeLibrary, session: GPhoto2Session, text: str, value: str | None
) -> None:
    library.widgets = {"customfuncex": Widget(text, kind=gp.GP_WIDGET_TEXT)}
    assert [one.value for one in session.settings()] == ([] if value is None else [value])


def test_of_two_bodies_without_a_number_the_one_in_its_socket_stays_whatever_the_bus_calls_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = {"usb:001,004": "1-1.2", "usb:001,005": "1-1.3"}

    def renumber() -> None:
        for port, name in ports.items():
            (tmp_path / name).mkdir(exist_ok=True)
            (tmp_path / name / "busnum").write_text(f"{int(port[4:7])}\n")
            (tmp_path / name / "devnum").write_text(f"{int(port[8:])}\n")
        (tmp_path / f"{name}:1.0").mkdir(exist_ok=True)  # an interface, which has no numbers

    library = FakeLibrary(widgets={"serialnumber": Widget("0" * 32)})
    monkeypatch.setattr(opening, "_DEVICES", tmp_path)
    monkeypatch.setattr(opening, "_candidates", lambda _ports: [("Canon EOS 450D", port) for port in sorted(ports)])
    monkeypatch.setattr(opening, "_opened", lambda _model, _port: library)
    renumber()
    first = opening.open_session(parse_settings({})).identity
    assert (first.port, first.serial) == ("usb:001,004", "usb 1-1.2")
    ports = {"usb:001,009": "1-1.2", "usb:001,008": "1-1.3"}
    renumber()
    again = opening.open_session(parse_settings({}), first.serial).identity
    assert (again.port, again.serial) == ("usb:001,009", "usb 1-1.2")
    assert opening.open_session(parse_settings({"serial": "usb 1-1.3"})).identity.port == "usb:001,008"
    del ports["usb:001,009"]  # it is gone: the other one is taken as another
    assert opening.open_session(parse_settings({}), first.serial).identity.serial == "usb 1-1.3"
