"""Poses of vehicle and camera, interpolation between samples, and the field of view; for daemon and products.

`camera_pose` loads pyproj: import it where it is needed.
"""

from dappled.decode.geometry.pose import Gnss, Pose, Quaternion, Symmetric, Vector3

__all__ = ["Gnss", "Pose", "Quaternion", "Symmetric", "Vector3"]
