"""What is asked of the benchmarks' figures (`limits.toml`), and how a benchmark prints its own."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LIMITS = Path(__file__).parent / "limits.toml"


@dataclass(frozen=True, slots=True)
class Limit:
    """What is asked of one figure. `noise` is the share by which it differs between runs of the same code."""

    benchmark: str
    figure: str
    text: str
    anchor: str
    at_most: float | None
    at_least: float | None
    noise: float

    @property
    def name(self) -> str:
        """As in `limits.toml`: benchmark.figure."""
        return f"{self.benchmark}.{self.figure}"

    @property
    def asked(self) -> str:
        """The limit in words."""
        words = [("at least", self.at_least), ("at most", self.at_most)]
        return ", ".join(f"{word} {value:g}" for word, value in words if value is not None)

    def missed(self, value: float, spread: float) -> bool:
        """Whether the limit is missed by more than the spread and the noise."""
        room = max(spread, self.noise * abs(value))
        low = self.at_least is not None and value + room < self.at_least
        return low or (self.at_most is not None and value - room > self.at_most)


def read_limits(path: Path = LIMITS) -> list[Limit]:
    """All limits, in the order of the file."""
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    return [
        Limit(
            benchmark,
            figure,
            asked["text"],
            asked.get("anchor", ""),
            asked.get("at_most"),
            asked.get("at_least"),
            asked["noise"],
        )
        for benchmark, figures in tables.items()
        for figure, asked in figures.items()
    ]


def flat(figures: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of nested tables by their path, joined by dots."""
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        elif isinstance(value, int | float):
            yield prefix + name, float(value)


def show(benchmark: str, figures: Mapping[str, Any], *, as_json: bool) -> None:
    """Print a benchmark's figures as JSON, or one a line with the limit behind it."""
    if as_json:
        print(json.dumps(figures, indent=1))
        return
    asked = {limit.figure: limit.asked for limit in read_limits() if limit.benchmark == benchmark}
    for name, value in flat(figures):
        print(f"{name:52} {value:12.4g}  {asked.get(name, '')}".rstrip())
