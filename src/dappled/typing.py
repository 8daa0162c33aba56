"""Types of what `dappled.open` and `dappled.subscribe` return, for annotations and isinstance."""

from dappled.daemon.stream.subscriber import Subscription
from dappled.daemon.stream.wire import Message
from dappled.decode.depth import DepthMap, DistanceMap
from dappled.decode.geometry import Gnss, GroundHeight, Pose
from dappled.decode.lightfield.refocus import StereoPair
from dappled.flight import Tag
from dappled.products.opened import Opened, OpenedFlight, OpenedFrame, OpenedLightField

__all__ = [
    "DepthMap",
    "DistanceMap",
    "Gnss",
    "GroundHeight",
    "Message",
    "Opened",
    "OpenedFlight",
    "OpenedFrame",
    "OpenedLightField",
    "Pose",
    "StereoPair",
    "Subscription",
    "Tag",
]
