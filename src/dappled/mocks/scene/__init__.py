"""Simulated scenes and the masked camera that photographs them."""
