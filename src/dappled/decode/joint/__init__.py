"""Views from slices by one model of the light field, and what the model tells of the mask and of clipped light."""

from __future__ import annotations
