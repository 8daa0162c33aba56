"""Rays, poses and footprints, for daemon and products."""
