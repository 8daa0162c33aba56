"""Process whole flights frame by frame, in many processes."""
