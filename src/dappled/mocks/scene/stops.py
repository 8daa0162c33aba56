"""Sample the stop of a lens as a continuous area: its points, how far each is open, and the view that it is in."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

StopShape = Literal["round", "square", "polygon"]
_PART = 8  # how far a cell is open is counted on so many points an axis


@dataclass(frozen=True, slots=True)
class StopPoints:
    """A stop within a square of side 1, as cells.

    `points` (J, 2) are (y, x) of each open cell's centre, row by row, `weights` (J,) their open areas, which sum
    to 1, and `view` (J,) the index of the view of each, row by row of n × n views over the square.
    """

    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    view: NDArray[np.intp]

    def view_weights(self, views: int) -> NDArray[np.float64]:
        """(n, n) the open share of each view's cell, which sum to 1."""
        weights = np.zeros(views * views)
        np.add.at(weights, self.view, self.weights)
        return weights.reshape(views, views)


def stop_points(
    shape: StopShape, views: int, points_per_view: int, *, blades: int = 5, turn_rad: float = 0
) -> StopPoints:
    """The cells of a stop, `points_per_view` an axis in each of `views` × `views`.

    A polygon has its corners on the circle of diameter 1, the first at `turn_rad` from the column axis. Raises
    ValueError for a stop without points.
    """
    if views < 1 or points_per_view < 1 or blades < 3:
        raise ValueError(f"a stop needs views, points and blades, not {views}, {points_per_view}, {blades}")
    n = views * points_per_view
    axis = (np.arange(n * _PART) + 0.5) / (n * _PART) - 0.5
    y, x = np.meshgrid(axis, axis, indexing="ij")
    if shape == "round":
        open_ = np.hypot(y, x) <= 0.5
    elif shape == "square":
        open_ = np.ones(y.shape, dtype=bool)
    else:
        middles = turn_rad + np.pi / blades + 2 * np.pi * np.arange(blades) / blades
        apothem = 0.5 * math.cos(math.pi / blades)
        open_ = np.logical_and.reduce([np.sin(a) * y + np.cos(a) * x <= apothem for a in middles])
    area = open_.reshape(n, _PART, n, _PART).sum(axis=(1, 3)).ravel()
    rows, columns = np.divmod(np.arange(n * n), n)
    view = rows // points_per_view * views + columns // points_per_view
    keep = area > 0
    points = (np.stack([rows, columns], axis=1)[keep] + 0.5) / n - 0.5
    return StopPoints(points, area[keep] / area.sum(), view[keep])


NODES = (-0.4, 0.0, 0.4)


def node_points() -> NDArray[np.float64]:
    """(9, 2) points (y, x) in shares of a stop's diameter, from which the light of every other point follows."""
    return np.stack(np.meshgrid(NODES, NODES, indexing="ij"), axis=-1).reshape(-1, 2)


def between_nodes(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(J, 9): what the light of each node counts at points (J, 2), by quadratic interpolation along both axes.

    Exact to 1 % of the finest detail where the picture moves by less than a quarter of its period over the stop.
    """
    along = np.stack([_quadratic(points[:, axis]) for axis in (0, 1)])
    return np.asarray(np.einsum("pi,pj->pij", along[0], along[1]).reshape(len(points), -1))


def _quadratic(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """(J, 3) Lagrange's polynomials of the nodes."""
    n = np.array(NODES)
    columns = [
        (at - n[(i + 1) % 3]) * (at - n[(i + 2) % 3]) / ((n[i] - n[(i + 1) % 3]) * (n[i] - n[(i + 2) % 3]))
        for i in range(3)
    ]
    return np.stack(columns, axis=1)
