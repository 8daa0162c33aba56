"""libgphoto2's errors as ours. Only the camera's own process imports this."""

from __future__ import annotations

import gphoto2 as gp

from dappled.drivers.gphoto2.protocol import BusyError, LostError, RefusedError, SessionError

LOST = {gp.GP_ERROR_IO, gp.GP_ERROR_TIMEOUT, gp.GP_ERROR_IO_INIT, gp.GP_ERROR_IO_READ, gp.GP_ERROR_IO_WRITE} | {
    gp.GP_ERROR_IO_USB_CLEAR_HALT,
    gp.GP_ERROR_IO_USB_FIND,
    gp.GP_ERROR_IO_USB_CLAIM,
    gp.GP_ERROR_OS_FAILURE,
    gp.GP_ERROR_LIBRARY,
}
"""The session is of no use any more."""


def sentence(error: gp.GPhoto2Error, what: str) -> str:
    """What the camera could not do, and why, in libgphoto2's words."""
    return f"the camera could not {what}: {error.string} ({error.code})"


def translated(error: gp.GPhoto2Error, what: str) -> SessionError:
    """libgphoto2's error as one of ours; `what` the camera could not do."""
    if error.code == gp.GP_ERROR_CAMERA_BUSY:
        return BusyError(f"the camera is too busy to {what}")
    if error.code in LOST:
        return LostError(sentence(error, what))
    return RefusedError(sentence(error, what))
