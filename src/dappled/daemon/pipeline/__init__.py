"""The way of one shot: shutter, capture, recording, tagging, decoding."""
