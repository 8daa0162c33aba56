"""What decoding one frame leaves for the next one of the same shape: buffers, and where the slices lie.

As with FFTW, a plan is built once and applied to many frames. A decoder owns its plans and lends them out, so that it
stays a value that several threads may use; the bytes that come out are the same with a fresh plan.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from dappled.decode.latest import Latest
from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.padded import Spectrum
from dappled.decode.spectrum.slices import SlicePlan, Slices, plan_slices
from dappled.decode.spectrum.transform import Source, Transform

_KEPT = 4  # layouts of slices a plan keeps: focal lengths that a zoom goes back to


class Plan:
    """Decodes frames of one shape, one at a time. A spectrum is valid until the next one is made."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._transform = Transform(shape)
        self._layouts: Latest[SlicePlan] = Latest(_KEPT)

    def spectrum(self, source: Source, *, workers: int = 1, largest_fx: float = 0.5) -> Spectrum:
        """The frame's spectrum up to `largest_fx` cycles/pixel along columns."""
        return self._transform.apply(source, workers=workers, largest_fx=largest_fx)

    def cut(
        self,
        spectrum: Spectrum,
        carriers: Sequence[Carrier],
        size: tuple[int, int] | None = None,
        *,
        workers: int = 1,
        beside: Sequence[Callable[[], None]] = (),
        **choices: Any,
    ) -> Slices:
        """As `slices.extract`; the same carriers and choices are laid out only once. Other work is done `beside`."""
        key = tuple(carriers), size, tuple(sorted(choices.items()))
        layout = self._layouts.of(key, lambda: plan_slices(spectrum.shape, spectrum.padded, carriers, size, **choices))
        return layout.apply(spectrum, workers=workers, beside=beside)


class Plans:
    """Plans by shape, lent to one frame at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: dict[tuple[int, int], list[Plan]] = {}

    @contextmanager
    def lend(self, shape: tuple[int, int]) -> Iterator[Plan]:
        """A plan that nobody else uses meanwhile."""
        with self._lock:
            waiting = self._free.setdefault(shape, [])
            plan = waiting.pop() if waiting else None
        plan = plan or Plan(shape)
        yield plan  # one that failed half way through a frame is not lent again
        with self._lock:
            self._free[shape].append(plan)
