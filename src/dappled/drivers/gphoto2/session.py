"""Find, open and use a camera through libgphoto2. Only the camera's own processes import this.

Every call may block for as long as libgphoto2 waits for a silent camera (up to 10 s), with the GIL held.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import gphoto2 as gp

from dappled.drivers.camera import Blob, Identity, Setting, SettingName
from dappled.drivers.gphoto2.intake import PIECE_BYTES, Incoming, Intake
from dappled.drivers.gphoto2.protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    CameraNews,
    CaptureComplete,
    CardContents,
    Fetched,
    FileAdded,
    FileFacts,
    LostError,
    NotOnBusError,
    RefusedError,
    SessionError,
    SettingTurned,
)
from dappled.drivers.gphoto2.settings import CaptureTarget, GPhoto2Settings

_DEVICES = Path("/sys/bus/usb/devices")
_FOLDERS = 256
"""More folders than a card has: bounds the walk."""
_DRAIN = 64
"""Events taken at once, so that a camera with many events can't keep the process from its commands."""
_LOST = {gp.GP_ERROR_IO, gp.GP_ERROR_TIMEOUT, gp.GP_ERROR_IO_INIT, gp.GP_ERROR_IO_READ, gp.GP_ERROR_IO_WRITE} | {
    gp.GP_ERROR_IO_USB_CLEAR_HALT,
    gp.GP_ERROR_IO_USB_FIND,
    gp.GP_ERROR_IO_USB_CLAIM,
    gp.GP_ERROR_OS_FAILURE,
    gp.GP_ERROR_LIBRARY,
}
"""Errors after which the session is unusable."""
_HELD = {gp.GP_ERROR_IO_USB_CLAIM, gp.GP_ERROR_IO_LOCK, gp.GP_ERROR_CAMERA_BUSY, gp.GP_ERROR}
_GONE = {gp.GP_ERROR_IO, gp.GP_ERROR_IO_USB_FIND, gp.GP_ERROR_MODEL_NOT_FOUND, gp.GP_ERROR_UNKNOWN_PORT}
_WIDGETS: dict[SettingName, tuple[str, ...]] = {
    "focal_length": ("focallength",),
    "aperture": ("aperture", "f-number"),
    "shutter_speed": ("shutterspeed", "shutterspeed2"),
    "iso": ("iso",),
    "image_format": ("imageformat", "imagequality"),
    "capture_target": ("capturetarget",),
    "battery": ("batterylevel",),
    "free_shots": ("availableshots",),
    "exposure_mode": ("autoexposuremode", "expprogram"),
    "focus_mode": ("focusmode", "focusmode2"),
    "drive_mode": ("drivemode", "capturemode"),
    "white_balance": ("whitebalance",),
    "auto_power_off": ("autopoweroff",),
    "mirror_lockup": ("customfuncex",),
}
"""libgphoto2's names of each setting; makers differ."""
_TURNED = frozenset(_WIDGETS) - {"battery", "free_shots", "capture_target"}
"""What a hand changes, between shots too: the body announces it."""
_RARELY = _TURNED - {"focal_length", "aperture", "shutter_speed", "iso", "image_format"}
"""Read at opening, and when the body announces a change, so that reading the rest after each shot stays short."""
_MODES = 24
"""More exposure modes than one body has. Where a body names none, a dial or a switch decides, and libgphoto2 lists the
41 modes of all bodies, or the one in force."""
_CHANGED = re.compile(r'PTP Property \w+ changed, "(\w+)" to "(.*)"')
_MIRROR_LOCKUP = re.compile(r"(?:^|,)60f,1,(\d+)(?:,|$)")
"""Canon's custom function 0x60f within "customfuncex": number, one value, the value (indilib/indi-3rdparty, 804)."""


def open_session(settings: GPhoto2Settings, before: str | None = None) -> GPhoto2Session:
    """Open the camera that the settings name; prefer the one with serial number `before`, which was open before. Raises
    AbsentError, HeldError, LostError."""
    trouble: list[SessionError] = []
    spare: GPhoto2Session | None = None
    others: list[str] = []
    for model, port in _candidates(settings.port):
        try:
            session = _session(model, port, settings.capture_target)
        except SessionError as error:
            trouble.append(error)
            continue
        if before is None or session.identity.serial == before:
            wanted = settings.serial is None or settings.serial in session.serials
        else:
            wanted = settings.serial is not None and settings.serial in session.serials
        if wanted:
            if spare is not None:
                spare.close()
            return session
        if settings.serial is None and spare is None:
            spare = session
            continue
        others.append(f"{session.identity.model} {session.identity.serial}")
        session.close()
    if spare is not None:
        return spare
    raise _none_found(settings, trouble, others)


def _none_found(settings: GPhoto2Settings, trouble: list[SessionError], others: list[str]) -> SessionError:
    for error in trouble:
        if not isinstance(error, AbsentError):
            return error
    if others:
        return NotOnBusError(f"no camera with serial number {settings.serial} is here, only {', '.join(others)}")
    if trouble:
        return trouble[0]
    return NotOnBusError("no camera is on USB: connect it, switch it on, and set its USB mode to PTP or PC connection")


def _session(model: str, port: str, target: CaptureTarget) -> GPhoto2Session:
    camera = _opened(model, port)
    try:
        return GPhoto2Session(camera, port, target)
    except gp.GPhoto2Error as error:
        _close(camera)
        raise _translated(error, "set up") from error


def _candidates(ports: str | None) -> Iterator[tuple[str, str]]:
    """Yield (model, port) of all cameras on the ports named: one, or several separated by commas; None: all on USB."""
    for port in [None] if ports is None else [each.strip() for each in ports.split(",")]:
        if port is not None and port.startswith("ptpip:"):
            yield "PTP/IP Camera", port
            continue
        found = gp.Camera.autodetect()
        for index in range(found.count()):
            where = found.get_value(index)
            if port in (None, "usb:", where):
                yield found.get_name(index), where


def _opened(model: str, port: str) -> Any:
    ports = gp.PortInfoList()
    ports.load()
    abilities = gp.CameraAbilitiesList()
    abilities.load()
    camera = gp.Camera()
    try:
        camera.set_port_info(ports[ports.lookup_path(port)])
        camera.set_abilities(abilities[abilities.lookup_model(model)])
        camera.init()
    except gp.GPhoto2Error as error:
        if error.code in _HELD:
            raise SessionError(
                f"the camera at {port} can't be opened ({error.string}): another program holds it, often the desktop's "
                "gvfs-gphoto2-volume-monitor; end that program"
            ) from error
        if error.code in _GONE:
            raise AbsentError(f"no camera answers at {port} ({error.string}): connect it and switch it on") from error
        raise SessionError(f"the camera at {port} can't be opened: {error.string}; switch it off and on") from error
    return camera


class GPhoto2Session:
    """An open camera; see `protocol.Session`."""

    def __init__(self, camera: Any, port: str, target: CaptureTarget) -> None:
        self._camera = camera
        printed = _text(camera, "eosserialnumber")  # as printed on the body; the PTP number is another
        reported = _text(camera, "serialnumber")
        reported = reported if reported.strip("0") else ""  # zeros are no number
        place = "" if printed or reported else _place(port)
        self.serials = {text for text in (printed, reported, reported.lstrip("0"), place) if text}
        self.identity = Identity(
            make=_text(camera, "manufacturer"),
            model=_text(camera, "cameramodel"),
            serial=printed or reported or place,
            port=port,
        )
        self._in_pieces = True
        self._read: dict[SettingName, Setting | None] = {}
        self.keeps_files = not (_set_target(camera, target) and target == "ram")

    def trigger(self) -> None:
        """Release the shutter."""
        try:
            self._camera.trigger_capture()
        except gp.GPhoto2Error as error:
            raise _translated(error, "release the shutter") from error

    def news(self) -> list[CameraNews]:
        """Return what happened since the last call, at most 64 events."""
        news: list[CameraNews] = []
        try:
            for _ in range(_DRAIN):
                kind, data = self._camera.wait_for_event(0)
                if kind == gp.GP_EVENT_TIMEOUT:
                    break
                if kind == gp.GP_EVENT_FILE_ADDED:
                    news.append(FileAdded(CameraFile(data.folder, data.name)))
                elif kind == gp.GP_EVENT_CAPTURE_COMPLETE:
                    news.append(CaptureComplete())
                elif kind == gp.GP_EVENT_UNKNOWN and self._turned(str(data)):
                    news.append(SettingTurned())
        except gp.GPhoto2Error as error:
            if not news:
                raise LostError(_sentence(error, "report what happens")) from error
        return news

    def fetch(self, file: CameraFile, intake: Intake, alive: Callable[[], None]) -> Fetched:
        """Fetch a file's bytes; from the card in pieces of at most 1 MiB, each of which is told."""
        try:
            return self._fetch(file, intake, alive)
        except gp.GPhoto2Error as error:
            raise _translated(error, f"send {file.name}") from error

    def _fetch(self, file: CameraFile, intake: Intake, alive: Callable[[], None]) -> Fetched:
        if file.in_memory:
            # libgphoto2 fetched it whole with the event, and keeps it until it is deleted.
            with self._whole(file, intake) as coming:
                blob = coming.finish()
            try:
                self._camera.file_delete(file.folder, file.name)
            except gp.GPhoto2Error:
                blob.close()
                raise
            return Fetched(blob)
        info = self._camera.file_get_info(file.folder, file.name).file
        announced: int = info.size
        if not announced:
            raise RefusedError(f"the camera announced 0 bytes of {file.name}")
        pieces = self._pieces(file, announced, intake, alive) if self._in_pieces else None
        self._in_pieces = pieces is not None
        with pieces or self._whole(file, intake) as coming:
            if coming.size != announced:
                raise RefusedError(f"the camera announced {announced} bytes of {file.name} and sent {coming.size}")
            return Fetched(coming.finish(), _time(info))

    def _pieces(self, file: CameraFile, size: int, intake: Intake, alive: Callable[[], None]) -> Incoming | None:
        """Read piece by piece; None where the body doesn't support that."""
        with ExitStack() as stack:
            coming = stack.enter_context(intake.begin(size))
            while asked := min(size - coming.size, PIECE_BYTES):
                try:
                    got = coming.take(asked, partial(self._piece, file, coming.size))
                except gp.GPhoto2Error as error:
                    if error.code == gp.GP_ERROR_NOT_SUPPORTED and coming.size == 0:
                        return None
                    raise
                alive()
                if got != asked:
                    break
            stack.pop_all()
        return coming

    def _piece(self, file: CameraFile, offset: int, into: memoryview) -> int:
        got: int = self._camera.file_read(file.folder, file.name, gp.GP_FILE_TYPE_NORMAL, offset, into)
        return got

    def _whole(self, file: CameraFile, intake: Intake) -> Incoming:
        held = self._camera.file_get(file.folder, file.name, gp.GP_FILE_TYPE_NORMAL)
        with ExitStack() as stack, memoryview(held.get_data_and_size()) as view:
            coming = stack.enter_context(intake.begin(len(view)))
            while coming.size < len(view):
                coming.take(len(view) - coming.size, partial(_copied, view[coming.size :]))
            stack.pop_all()
        return coming

    def about(self, file: CameraFile) -> FileFacts:
        """Return size and time of a file on the card."""
        try:
            info = self._camera.file_get_info(file.folder, file.name).file
        except gp.GPhoto2Error as error:
            raise _translated(error, f"report the size and time of {file.name}") from error
        return info.size, _time(info)

    def delete(self, file: CameraFile) -> None:
        """Delete a file on the card."""
        try:
            self._camera.file_delete(file.folder, file.name)
        except gp.GPhoto2Error as error:
            raise _translated(error, f"delete {file.name}") from error

    def files(self) -> frozenset[CameraFile]:
        """List all files on the card, from libgphoto2's memory where it has them."""
        found: set[CameraFile] = set()
        folders = ["/"]
        try:
            for folder in folders:
                found.update(CameraFile(folder, name) for name in _names(self._camera.folder_list_files(folder)))
                inner = _names(self._camera.folder_list_folders(folder))
                folders.extend(f"{folder.rstrip('/')}/{name}" for name in inner[: _FOLDERS - len(folders)])
        except gp.GPhoto2Error as error:
            raise LostError(_sentence(error, "list its card")) from error
        return frozenset(file for file in found if not file.in_memory)

    def contents(self) -> CardContents:
        """What is on the card. After a listing libgphoto2 knows sizes and times, too. A file that went meanwhile is
        left out."""
        found: dict[CameraFile, FileFacts] = {}
        for file in self.files():
            with contextlib.suppress(BusyError, RefusedError):
                found[file] = self.about(file)
        return CardContents(found, self._card())

    def _card(self) -> str:
        """What the camera says of its cards, "" where it says nothing."""
        try:
            stores = self._camera.get_storageinfo()
        except gp.GPhoto2Error as error:
            if error.code in _LOST:
                raise LostError(_sentence(error, "say which card it has")) from error
            return ""
        return "; ".join(f"{one.basedir} {one.label} {one.description} {one.capacitykbytes}" for one in stores)

    def _turned(self, event: str) -> bool:
        """Whether an event says that a setting has another value than the one that was read. Reading makes events, too:
        these repeat what was read."""
        found = _CHANGED.search(event)
        name = found and next((name for name in _TURNED if found[1] in _WIDGETS[name]), None)
        if not found or name is None or name not in self._read:
            return False
        known, now = self._read[name], _value(name, found[2])
        if now is None or (known is not None and known.value == now):
            return False
        del self._read[name]
        return True

    def settings(self) -> tuple[Setting, ...]:
        """Read all settings that the camera has; of those that change rarely what is known."""
        wanted = [name for name in _WIDGETS if name not in _RARELY or name not in self._read]
        self._read |= _read_settings(self._camera, wanted)
        return tuple(one for name in _WIDGETS if (one := self._read[name]) is not None)

    def change(self, name: SettingName, value: str) -> None:
        """Change a setting."""
        self._read.pop(name, None)
        _change_setting(self._camera, name, value)
        if name == "capture_target":
            self.keeps_files = "ram" not in value.lower()

    def preview(self) -> Blob:
        """Read a JPEG of the viewfinder, which switches live view on."""
        try:
            held = self._camera.capture_preview()
        except gp.GPhoto2Error as error:
            if error.code == gp.GP_ERROR_NOT_SUPPORTED:
                raise RefusedError("this body has no live view") from error
            raise _translated(error, "show its viewfinder") from error
        with memoryview(held.get_data_and_size()) as view:
            return Blob.of(view, "viewfinder")

    def end_preview(self) -> None:
        """Switch live view off, where the body has a setting for that; others end it with the next shot."""
        try:
            widget = _widget(self._camera, ("viewfinder", "eosviewfinder"))
            if widget is not None:
                widget.set_value(0)
                self._camera.set_single_config(widget.get_name(), widget)
        except gp.GPhoto2Error as error:
            if error.code in _LOST:
                raise LostError(_sentence(error, "end live view")) from error

    def close(self) -> None:
        """End the session."""
        _close(self._camera)


def _place(port: str) -> str:
    """Where on the bus a body stands ("usb 1-1.2": bus, socket, socket of the hub), which stays when buses are numbered
    anew. It stands for the serial number of a body that has none, so that of two the one is not taken for the other;
    "" where the system doesn't tell."""
    found = re.fullmatch(r"usb:(\d+),(\d+)", port)
    for device in () if found is None else sorted(_DEVICES.glob("*-*")):
        with contextlib.suppress(OSError, ValueError):
            numbers = [int((device / name).read_text(encoding="ascii")) for name in ("busnum", "devnum")]
            if found is not None and numbers == [int(found[1]), int(found[2])]:
                return f"usb {device.name}"
    return ""


def _copied(view: memoryview, into: memoryview) -> int:
    into[:] = view[: len(into)]
    return len(into)


def _time(info: Any) -> int | None:
    return info.mtime if info.fields & gp.GP_FILE_INFO_MTIME and info.mtime > 0 else None


def _names(found: Any) -> list[str]:
    return [found.get_name(index) for index in range(found.count())]


def _close(camera: Any) -> None:
    """End a session; never raises."""
    with contextlib.suppress(gp.GPhoto2Error):  # a broken link can't be closed properly
        camera.exit()


# --- settings


def _read_settings(camera: Any, wanted: Iterable[SettingName]) -> dict[SettingName, Setting | None]:
    """Read each setting by the first of its names that the body has, None without any. Raises LostError."""
    try:
        return {name: _read_setting(camera, name, _WIDGETS[name]) for name in wanted}
    except gp.GPhoto2Error as error:
        raise LostError(_sentence(error, "report its settings")) from error


def _change_setting(camera: Any, name: SettingName, value: str) -> None:
    """Change a setting. Raises BusyError, RefusedError, LostError."""
    try:
        widget = _widget(camera, _WIDGETS[name])
        if widget is None:
            raise RefusedError(f"the camera has no setting {name}")
        widget.set_value(value)
        camera.set_single_config(widget.get_name(), widget)
    except gp.GPhoto2Error as error:
        raise _translated(error, f"set {name} to {value}") from error


def _text(camera: Any, name: str) -> str:
    """Read a widget as text, "" where the body has none of this name. Raises GPhoto2Error."""
    widget = _widget(camera, (name,))
    return "" if widget is None else str(widget.get_value() or "").strip()


def _set_target(camera: Any, target: CaptureTarget) -> bool:
    """Set where pictures go, which bodies forget between sessions. False where the body has no choice. Raises
    GPhoto2Error."""
    word = "ram" if target == "ram" else "card"
    try:
        widget = camera.get_single_config("capturetarget")
        choice = next((each for each in widget.get_choices() if word in each.lower()), None)
        if choice is None:
            return False
        widget.set_value(choice)
        camera.set_single_config("capturetarget", widget)
    except gp.GPhoto2Error as error:
        if error.code in _LOST:
            raise
        return False
    return True


def _read_setting(camera: Any, name: SettingName, widgets: tuple[str, ...]) -> Setting | None:
    widget = _widget(camera, widgets)
    if widget is None:
        return None
    value = _value(name, str(widget.get_value()))
    if value is None:
        return None
    if name == "auto_power_off":  # seconds, as text: 0 is never
        return Setting(name, value, () if widget.get_readonly() else ("0", value)[: 1 + (value != "0")])
    settable = widget.get_type() in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU) and not widget.get_readonly()
    choices = tuple(widget.get_choices()) if settable else ()
    if name in ("exposure_mode", "focus_mode") and not 1 < len(choices) <= _MODES:
        choices = ()
    return Setting(name, value, choices)


def _value(name: SettingName, text: str) -> str | None:
    """A widget's value as the setting's; None where it says nothing. Mirror lock-up is one of the custom functions, and
    only read: bodies have refused to shoot after these had been written."""
    if name != "mirror_lockup":
        return text
    found = _MIRROR_LOCKUP.search(text)
    return None if found is None else "off" if found[1] == "0" else "on"


def _widget(camera: Any, names: tuple[str, ...]) -> Any:
    """Return the first of these widgets that the body has; None without any."""
    for name in names:
        try:
            return camera.get_single_config(name)
        except gp.GPhoto2Error as error:
            if error.code in _LOST:
                raise
    return None


# --- errors


def _sentence(error: gp.GPhoto2Error, what: str) -> str:
    """Say what the camera could not do, and why in libgphoto2's words."""
    return f"the camera could not {what}: {error.string} ({error.code})"


def _translated(error: gp.GPhoto2Error, what: str) -> SessionError:
    """Convert libgphoto2's error; `what` is what the camera could not do."""
    if error.code == gp.GP_ERROR_CAMERA_BUSY:
        return BusyError(f"the camera is too busy to {what}")
    if error.code in _LOST:
        return LostError(_sentence(error, what))
    return RefusedError(_sentence(error, what))
