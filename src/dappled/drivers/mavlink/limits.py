"""What no vehicle exceeds: the same for a live link and for every kind of log."""

from __future__ import annotations

HIGHEST_M = 100_000.0  # above or below the sea's level
FASTEST_M_S = 300.0
