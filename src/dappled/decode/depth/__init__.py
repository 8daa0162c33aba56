"""Depth from a light field: evidence, methods, ranging, depth maps."""
