"""Simulated camera bodies: PTP/IP, cards, raw files, USB devices."""
