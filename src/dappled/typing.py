"""Types of what `dappled.open` and `dappled.subscribe` return, for annotations and isinstance."""

from dappled.daemon.stream.subscriber import Subscription
from dappled.daemon.stream.wire import Message
from dappled.products.opened import OpenedFlight, OpenedFrame, OpenedLightField

__all__ = ["Message", "OpenedFlight", "OpenedFrame", "OpenedLightField", "Subscription"]
