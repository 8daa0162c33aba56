"""Recorded flights through the same pipeline again: replay, late tags, later decoding."""
