"""The odds that say a mask is there, for one frame and for a flight's frames together."""

from __future__ import annotations

SEEN_NATS = 4.6
"""Odds of 100. Without a mask they are 1 on average, whatever the scene, and above this in at most 1 % of frames."""
