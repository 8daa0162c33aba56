"""Frames and flights as maps, terrain and footprints."""
