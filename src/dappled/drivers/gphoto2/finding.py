"""Find a body and open it: by port, by serial number, the same one again after a break. For the camera's process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gphoto2 as gp

from dappled.drivers.gphoto2.errors import translated
from dappled.drivers.gphoto2.protocol import AbsentError, HeldError, SessionError
from dappled.drivers.gphoto2.session import GPhoto2Session, let_go
from dappled.drivers.gphoto2.settings import CaptureTarget, GPhoto2Settings

_HELD = {gp.GP_ERROR_IO_USB_CLAIM, gp.GP_ERROR_IO_LOCK, gp.GP_ERROR_CAMERA_BUSY, gp.GP_ERROR}
_GONE = {gp.GP_ERROR_IO, gp.GP_ERROR_IO_USB_FIND, gp.GP_ERROR_MODEL_NOT_FOUND, gp.GP_ERROR_UNKNOWN_PORT}


def open_session(settings: GPhoto2Settings, before: str | None = None) -> GPhoto2Session:
    """The camera that the settings name, ready to fire; `before` is the serial number of the one that was open before,
    which is preferred to others. Raises AbsentError, HeldError, LostError."""
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
    raise _nobody(settings, trouble, others)


def _nobody(settings: GPhoto2Settings, trouble: list[SessionError], others: list[str]) -> SessionError:
    for error in trouble:
        if not isinstance(error, AbsentError):
            return error
    if others:
        return AbsentError(f"no camera with serial number {settings.serial} is here, only {', '.join(others)}")
    if trouble:
        return trouble[0]
    return AbsentError("no camera is on USB: connect it, switch it on, and set its USB mode to PTP or PC connection")


def _session(model: str, port: str, target: CaptureTarget) -> GPhoto2Session:
    camera = _opened(model, port)
    try:
        return GPhoto2Session(camera, port, target)
    except gp.GPhoto2Error as error:
        let_go(camera)
        raise translated(error, "set up") from error


def _candidates(ports: str | None) -> Iterator[tuple[str, str]]:
    """(model, port) of all cameras on the ports named: one, or several with commas between; None: all on USB."""
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
            raise HeldError(
                f"the camera at {port} can't be opened ({error.string}): another program holds it, often the desktop's "
                "gvfs-gphoto2-volume-monitor; end that program"
            ) from error
        if error.code in _GONE:
            raise AbsentError(f"no camera answers at {port} ({error.string}): connect it and switch it on") from error
        raise HeldError(f"the camera at {port} can't be opened: {error.string}; switch it off and on") from error
    return camera
