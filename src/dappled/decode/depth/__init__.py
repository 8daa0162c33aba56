"""Depth from a light field: evidence, methods, maps, ranging."""

from __future__ import annotations

from dappled.decode.depth.depth_map import DepthMap
from dappled.decode.depth.ranging import RANGING, DistanceMap, Ranging

__all__ = ["RANGING", "DepthMap", "DistanceMap", "Ranging"]
