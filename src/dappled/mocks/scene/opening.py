"""How the light through a lens' stop is summed from the few points of the aperture that are rendered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.optics import Order
from dappled.mocks.scene import lens, stops
from dappled.mocks.scene.lens import Installation, Optics

POINTS_PER_VIEW = 4


@dataclass(frozen=True, slots=True)
class Opening:
    """A stop as points.

    Light is rendered from `nodes_mm` (J, 2). It comes through `points_mm` (P, 2), the share `shares` (P,) through each,
    which sees what the nodes see, weighted by its row of `between` (P, J). `views` (V, J) likewise makes each view: the
    mean of its cell.
    """

    nodes_mm: NDArray[np.float64]
    points_mm: NDArray[np.float64]
    shares: NDArray[np.float64]
    between: NDArray[np.float64]
    views: NDArray[np.float64]

    @classmethod
    def of_beams(cls, points_mm: NDArray[np.float64]) -> Opening:
        """As many thin beams as there are points (n, n, 2), each of them a view."""
        points = points_mm.reshape(-1, 2)
        same = np.eye(len(points))
        return cls(points, points, np.full(len(points), 1 / len(points)), same, same)

    @classmethod
    def round(cls, diameter_mm: float, views: int) -> Opening:
        """A round stop, open everywhere: 4 × 4 points in each of `views` × `views` cells over its square."""
        stop = stops.stop_points("round", views, POINTS_PER_VIEW)
        between = stops.between_nodes(stop.points)
        cells = np.zeros((views * views, len(between[0])))
        np.add.at(cells, stop.view, stop.weights[:, None] * between)
        open_share = stop.view_weights(views).reshape(-1, 1)
        points_mm, nodes_mm = stop.points * diameter_mm, stops.node_points() * diameter_mm
        return cls(nodes_mm, points_mm, stop.weights, between, cells / open_share)

    def angular(self, optics: Optics, installed: Installation, orders: list[Order]) -> NDArray[np.complex128]:
        """(K, J): what the light of each node counts in the slice of each order."""
        phases = lens.angular_phases(optics, installed, orders, self.points_mm)
        return np.asarray((phases * self.shares) @ self.between)

    def seen(self, radiance: Singles) -> Singles:
        """The views (V, 3, h, w) of light (J, 3, h, w) at the nodes."""
        if len(self.views) == len(radiance):
            return radiance
        return np.asarray(np.tensordot(self.views.astype(np.float32), radiance, axes=1))
