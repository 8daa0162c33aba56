"""dappled: acquisition daemon for masked light-field cameras that fly.

The names in `__all__` are the public face; `docs/api.md` says what is promised of them, and which other modules are
public. Each is loaded when it is first used, so that importing dappled is cheap.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

__all__ = ["Camera", "__version__", "open", "subscribe"]

_MODULES = {
    "Camera": "dappled.drivers.camera",
    "open": "dappled.products.opened",
    "subscribe": "dappled.daemon.stream.subscriber",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'dappled' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
