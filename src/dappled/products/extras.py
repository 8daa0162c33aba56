"""Import libraries of extras (`ground`, `cluster` …) where they are needed; the onboard install has none."""

from __future__ import annotations

import importlib
from typing import Any

from dappled.errors import DappledError, install_extra

_PACKAGES = {
    "cv2": "opencv-python-headless",
    "distributed": "distributed",
    "mcap": "mcap",
    "mcap_ros2": "mcap-ros2-support",
    "rerun": "rerun-sdk",
}
_EXTRAS = {"distributed": "cluster", "mcap": "ros", "mcap_ros2": "ros", "rerun": "rerun"}


class MissingExtraError(DappledError):
    """A library of an extra is not installed; one sentence."""


def need(module: str, instead: str = "") -> Any:
    """Import an optional module. Raises MissingExtraError: what to install, or use `instead`, or why an installed one
    can't be loaded."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        root = module.partition(".")[0]
        if not (isinstance(error, ModuleNotFoundError) and error.name == root):
            raise MissingExtraError(f"{_PACKAGES.get(root, root)} is installed but can't be loaded: {error}") from error
        extra = _EXTRAS.get(root, "ground")
        otherwise = f" (or {instead})" if instead else ""
        raise MissingExtraError(f"this needs {_PACKAGES.get(root, root)}; {install_extra(extra)}{otherwise}") from error
