"""What decoding a frame gives: the light field, the report, and what is in doubt about them."""

from __future__ import annotations

from dataclasses import dataclass, field

from dappled.decode.calibration.law_search import LawSearch
from dappled.decode.decoder import DecodeReport
from dappled.decode.lightfield import LightField
from dappled.drivers.raw.law_check import LawCheck
from dappled.drivers.raw.raw_file import Exposure, RawFile


@dataclass(frozen=True, slots=True)
class DecodeResult:
    """A decoded frame, its report and raw file, and how many milliseconds each step took.

    `checked` is whether its carriers stand where slices are cut, where that was checked. `calibration_doubt` is what
    the calibration itself was in doubt about, `exposed` how the file's values are, `not_linear` why they may not follow
    the light in the scene, vignetting among it.
    """

    light_field: LightField
    report: DecodeReport
    raw: RawFile
    exposed: Exposure
    ms: dict[str, float] = field(default_factory=dict)
    checked: LawCheck | None = None
    calibration_doubt: str | None = None
    not_linear: tuple[str, ...] = ()

    @property
    def search(self) -> LawSearch | None:
        """What the frame shows under all laws; None where they were not tried."""
        return None if self.checked is None else self.checked.search

    @property
    def contradiction(self) -> str | None:
        """Why carriers should be visible and are not, or stand elsewhere; None where there is no such reason."""
        return None if self.checked is None else self.checked.contradiction

    @property
    def unsettled(self) -> str | None:
        """What can't be told of the carriers, or is strange about those that are there; None where nothing is."""
        return None if self.checked is None else self.checked.unsettled

    @property
    def doubts(self) -> tuple[str, ...]:
        """All that is in doubt about the frame, a sentence each."""
        found = (self.contradiction, self.unsettled, self.report.doubt, self.calibration_doubt, *self.not_linear)
        return tuple(words for words in found if words)

    @property
    def observable(self) -> bool:
        """False where no carrier is seen, and none needs to be at this aperture and in this scene."""
        return self.report.found > 1 or self.contradiction is not None or self.search is None

    @property
    def carriers_found(self) -> int:
        """Carriers seen in the whole plane without the mean: those of the half plane and their conjugates."""
        return 2 * (self.report.found - 1)

    @property
    def carriers_predicted(self) -> int:
        """Carriers predicted on the sensor, counted in the same way."""
        return 2 * (len(self.report.predicted) - 1)
