"""Draw views, slices, spectrum and depth with matplotlib, for notebooks and papers; `OpenedLightField.plot` calls this.

matplotlib is part of the extra `ground` and is imported when something is drawn. Each function draws into `axes`, or
into a new figure, and returns the axes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dappled.decode import DecodeError
from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.light_field import slice_mosaic
from dappled.decode.optics import Carrier
from dappled.decode.spectrum import Plane
from dappled.decode.spectrum.pictures import spectrum_boxes
from dappled.products.extras import need

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST = 1600  # pixels of a mosaic: more than a figure shows
_GAMMA = 1 / 2.2
_UNKNOWN, _HATCH = "0.8", "////"  # light grey and hatched, for pixels without a value


def bright(picture: NDArray[np.floating]) -> NDArray[np.float32]:
    """A linear picture as a screen shows it: 0 to 1, the 99.5th percentile white, NaN black, gamma 2.2."""
    known = picture[np.isfinite(picture)]
    top = float(np.quantile(known, 0.995)) if known.size else 1.0
    made: NDArray[np.float32] = np.clip(np.nan_to_num(picture) / max(top, 1e-9), 0, 1).astype(np.float32) ** _GAMMA
    return made


def views(field: LightField, axes: Axes | None = None) -> Axes:
    """Draw all views side by side, v downwards and u to the right. Raises DecodeError where there are none."""
    rows, columns = field.views.shape[:2]
    if 0 in field.views.shape:
        raise DecodeError("the light field has no views: decode the frame with a calibration")
    step = max(1, -(-max(rows * field.views.shape[2], columns * field.views.shape[3]) // _LONGEST))
    tiles = field.views[:, :, ::step, ::step]
    mosaic = np.concatenate([np.concatenate(list(row), axis=1) for row in tiles], axis=0)
    made = _axes(axes)
    made.imshow(bright(mosaic), cmap="gray", vmin=0, vmax=1)
    made.set(xticks=[], yticks=[], xlabel="u", ylabel="v", title=f"{rows} × {columns} views")
    return made


def slices(field: LightField, axes: Axes | None = None) -> Axes:
    """Draw the slices' magnitudes at their orders, each from 0 to its own white, with their conjugates."""
    _needs_slices(field)
    made = _axes(axes)
    made.imshow(slice_mosaic(field.slices, field.carriers, longest_side=_LONGEST), cmap="gray", vmin=0, vmax=255)
    made.set(xticks=[], yticks=[], xlabel="kx", ylabel="ky", title=f"{len(field.slices)} slices and their conjugates")
    return made


def bands(field: LightField, axes: Axes | None = None) -> Axes:
    """Draw the logarithm of each slice's spectrum where its band lies in the spectrum of the frame."""
    _needs_slices(field)
    made = _axes(axes)
    spectra = np.log(np.abs(np.fft.fftshift(np.fft.fft2(field.slices), axes=(1, 2))) + 1e-9)
    low, high = np.quantile(spectra, [0.02, 0.9999])
    half_y, half_x = _band_cycles(field)[0] / 2, _band_cycles(field)[1] / 2
    for (_, _, fy, fx), spectrum in zip(field.carriers, spectra, strict=True):
        for sign, shown in ((1, spectrum), (-1, spectrum[::-1, ::-1])):
            y, x = sign * fy, sign * fx
            made.imshow(
                shown, cmap="gray", vmin=low, vmax=high, extent=(x - half_x, x + half_x, y + half_y, y - half_y)
            )
    return _in_cycles(made, "bands of the slices")


def spectrum(plane: Plane, field: LightField, axes: Axes | None = None) -> Axes:
    """Draw the magnitude of a frame's spectrum with a red box around each slice's band and a ring at each carrier."""
    _needs_slices(field)
    carriers = [Carrier(int(ky), int(kx), float(fy), float(fx)) for ky, kx, fy, fx in field.carriers]
    made = _axes(axes)
    made.imshow(spectrum_boxes(plane, carriers, _band_cycles(field)), extent=(-0.5, 0.5, 0.5, -0.5))
    return _in_cycles(made, "spectrum and carriers")


def depth(values: NDArray[np.float32], unit: str, title: str, axes: Axes | None = None) -> Axes:
    """Draw a map of disparities or distances with its scale, from the 1st to the 99th percentile; unknown is hatched.

    Raises DecodeError where nothing is known.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        raise DecodeError("no pixel has a known depth, so there is nothing to draw: the scene may lack texture")
    low, high = (float(x) for x in np.quantile(known, [0.01, 0.99]))
    made = _axes(axes)
    made.set_facecolor(_UNKNOWN)
    made.patch.set(hatch=_HATCH, edgecolor="0.45")
    shown = made.imshow(values, vmin=low, vmax=high, cmap="viridis")
    made.figure.colorbar(shown, ax=made, label=unit, shrink=0.8)
    made.set(xticks=[], yticks=[], title=f"{title}, {known.size / values.size:.0%} known")
    return made


def _needs_slices(field: LightField) -> None:
    if 0 in field.slices.shape:
        raise DecodeError("the light field has no slices: it was read from pictures")


def _band_cycles(field: LightField) -> tuple[float, float]:
    """Height and width of a band in cycles/pixel: the inverse of a slice's sample pitch."""
    return 1 / float(np.hypot(*field.grid[:, 0])), 1 / float(np.hypot(*field.grid[:, 1]))


def _in_cycles(axes: Axes, title: str) -> Axes:
    axes.set(xlim=(-0.5, 0.5), ylim=(0.5, -0.5), xlabel="fx, cycles/pixel", ylabel="fy, cycles/pixel", title=title)
    axes.set_aspect("equal")
    axes.set_facecolor("black")
    return axes


def _axes(axes: Axes | None) -> Axes:
    if axes is not None:
        return axes
    made: Axes = need("matplotlib.pyplot").figure(layout="constrained").add_subplot()
    return made
