"""Whole flights, frame by frame, on many processes."""
