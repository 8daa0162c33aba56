"""A body's settings through libgphoto2's widgets. Only the camera's own process imports this."""

from __future__ import annotations

from typing import Any

import gphoto2 as gp

from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.gphoto2.errors import LOST, sentence, translated
from dappled.drivers.gphoto2.protocol import LostError, RefusedError
from dappled.drivers.gphoto2.settings import CaptureTarget

_WIDGETS: dict[SettingName, tuple[str, ...]] = {
    "focal_length": ("focallength",),
    "aperture": ("aperture", "f-number"),
    "shutter_speed": ("shutterspeed", "shutterspeed2"),
    "iso": ("iso",),
    "image_format": ("imageformat", "imagequality"),
    "capture_target": ("capturetarget",),
    "battery": ("batterylevel",),
    "free_shots": ("availableshots",),
}
"""What libgphoto2 calls each setting; makers differ."""


def read(camera: Any) -> tuple[Setting, ...]:
    """What can be read of an open camera, by the first of its maker's names that the body knows. Raises LostError."""
    try:
        found = [_setting(camera, name, widgets) for name, widgets in _WIDGETS.items()]
    except gp.GPhoto2Error as error:
        raise LostError(sentence(error, "tell its settings")) from error
    return tuple(each for each in found if each is not None)


def change(camera: Any, name: SettingName, value: str) -> None:
    """Set one of them. Raises BusyError, RefusedError, LostError."""
    try:
        widget = _widget(camera, _WIDGETS[name])
        if widget is None:
            raise RefusedError(f"the camera has no setting {name}")
        widget.set_value(value)
        camera.set_single_config(widget.get_name(), widget)
    except gp.GPhoto2Error as error:
        raise translated(error, f"set {name} to {value}") from error


def text(camera: Any, name: str) -> str:
    """What a widget says, "" where the body has none of this name. Raises GPhoto2Error."""
    widget = _widget(camera, (name,))
    return "" if widget is None else str(widget.get_value() or "").strip()


def set_target(camera: Any, target: CaptureTarget) -> bool:
    """Where pictures go: bodies forget this between sessions. False where the body has no choice. Raises
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
        if error.code in LOST:
            raise
        return False
    return True


def _setting(camera: Any, name: SettingName, widgets: tuple[str, ...]) -> Setting | None:
    widget = _widget(camera, widgets)
    if widget is None:
        return None
    settable = widget.get_type() in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU) and not widget.get_readonly()
    return Setting(name, str(widget.get_value()), tuple(widget.get_choices()) if settable else ())


def _widget(camera: Any, names: tuple[str, ...]) -> Any:
    """The first of these that the body has; None without any."""
    for name in names:
        try:
            return camera.get_single_config(name)
        except gp.GPhoto2Error as error:
            if error.code in LOST:
                raise
    return None
