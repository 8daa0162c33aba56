"""Poses of vehicle and camera, interpolation between samples, field of view and footprint; for daemon and products."""

from dappled.decode.geometry.pose import (
    FrameGeometry,
    Gnss,
    GroundHeight,
    Pose,
    Quaternion,
    Symmetric,
    Vector3,
    conjugate,
    displacement,
    from_euler,
    hermite,
    hermite_doubt,
    image_motion,
    metres_per_radian,
    multiply,
    norm,
    normalised,
    rotation_vector,
    slerp,
    slerp_doubt,
    turn_rad,
    turn_rates,
    turned,
    turned_by_heading,
)

__all__ = [
    "FrameGeometry", "Gnss", "GroundHeight", "Pose", "Quaternion", "Symmetric", "Vector3", "conjugate", "displacement",
    "from_euler", "hermite", "hermite_doubt", "image_motion", "metres_per_radian", "multiply", "norm", "normalised",
    "rotation_vector", "slerp", "slerp_doubt", "turn_rad", "turn_rates", "turned", "turned_by_heading",
]  # fmt: skip
