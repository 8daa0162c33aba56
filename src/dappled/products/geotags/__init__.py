"""Where each frame was taken, in the forms that other programs read."""
