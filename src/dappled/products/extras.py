"""Import libraries of the extras `ground`, `cluster` and `ros` where they are needed; the onboard install has none."""

from __future__ import annotations

import importlib
from typing import Any

from dappled.errors import DappledError, install_extra

_PACKAGES = {
    "cv2": "opencv-python-headless",
    "distributed": "distributed",
    "mcap": "mcap",
    "mcap_ros2": "mcap-ros2-support",
}
_EXTRAS = {"distributed": "cluster", "mcap": "ros", "mcap_ros2": "ros"}


class MissingExtraError(DappledError):
    """A library of an extra is not installed; one sentence."""


def need(module: str) -> Any:
    """Import an optional module. Raises MissingExtraError: what to install, or why an installed one can't be loaded."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        root = module.partition(".")[0]
        if not (isinstance(error, ModuleNotFoundError) and error.name == root):
            raise MissingExtraError(f"{_PACKAGES.get(root, root)} is installed but can't be loaded: {error}") from error
        extra = _EXTRAS.get(root, "ground")
        raise MissingExtraError(f"this needs {_PACKAGES.get(root, root)}; {install_extra(extra)}") from error
