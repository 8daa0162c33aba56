"""The picture at the sensor's own resolution: the mask's shadow in a frame, and what is left when it is divided out."""

from __future__ import annotations
