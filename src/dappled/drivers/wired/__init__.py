"""Cameras made of a shutter line and a place where their files appear."""
