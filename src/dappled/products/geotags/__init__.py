"""Write where each frame was taken, in the formats that other programs read."""
