"""The simulated chip: light in, the raw file's numbers out, with noise and clipping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Sensor
from dappled.mocks.scene.lens import Floats


@dataclass(frozen=True, slots=True)
class SensorModel:
    """The chip: an RGGB mosaic whose three colours are balanced (`mono`: without colour filters), 14 bits in 16.

    `shot_noise` and `read_noise_e` (electrons rms) are there to be switched off.
    """

    shape: tuple[int, int] = (2776, 3688)
    pitch_mm: float = 0.01
    black: int = 1024
    white: int = 15360
    full_well_e: float = 30_000.0
    shot_noise: bool = True
    read_noise_e: float = 6.0
    mono: bool = False

    @property
    def chip(self) -> Sensor:
        """Shape and pitch in the decoder's words."""
        return Sensor(self.shape, (self.pitch_mm, 0.0), (0.0, self.pitch_mm))

    def develop(self, plane: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Light (1.0 = white) as the numbers of the raw file, with noise, clipped at white."""
        electrons = plane * np.float32(self.full_well_e)
        variance = np.full((), self.read_noise_e**2, dtype=np.float32)
        if self.shot_noise:
            variance = variance + np.maximum(electrons, 0)
        if self.shot_noise or self.read_noise_e:
            electrons += np.sqrt(variance) * rng.standard_normal(plane.shape, dtype=np.float32)
        electrons *= np.float32((self.white - self.black) / self.full_well_e)
        electrons += np.float32(self.black + 0.5)
        return np.asarray(np.clip(electrons, 0, self.white), dtype=np.uint16)
