"""Light field, aperture and views; refocusing, focal stacks, stereo pairs."""

from __future__ import annotations

from dappled.decode.lightfield.light_field import LightField, ViewStack

__all__ = ["LightField", "ViewStack"]
