"""Types of what `dappled.open` and `dappled.subscribe` return, for annotations and isinstance."""

from dappled.daemon.stream.subscriber import Subscription
from dappled.daemon.stream.wire import Message
from dappled.decode.depth import DepthMap, DistanceMap
from dappled.decode.geometry import Gnss, GroundHeight, Pose
from dappled.decode.lightfield.refocus import StereoPair
from dappled.findings import Code, Fault, Finding, Level, Subject, Value
from dappled.flight import Tag, TimeSource
from dappled.products.opened import Opened, OpenedFlight, OpenedFrame, OpenedLightField, SharpPicture

__all__ = [
    "Code",
    "DepthMap",
    "DistanceMap",
    "Fault",
    "Finding",
    "Gnss",
    "GroundHeight",
    "Level",
    "Message",
    "Opened",
    "OpenedFlight",
    "OpenedFrame",
    "OpenedLightField",
    "Pose",
    "SharpPicture",
    "StereoPair",
    "Subject",
    "Subscription",
    "Tag",
    "TimeSource",
    "Value",
]
