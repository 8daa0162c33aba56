"""Cameras that libgphoto2 drives, in a process of their own, and the client of that process."""
