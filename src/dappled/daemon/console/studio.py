"""Make the pictures of a frame that the page asks for, once each, and keep the last ones in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.daemon.console import pictures
from dappled.daemon.console.pictures import Mosaic
from dappled.daemon.console.placement import oriented_frame
from dappled.daemon.stream.wire import Message
from dappled.decode.decoder import MaskDecoder
from dappled.decode.geometry import footprint
from dappled.decode.geometry.footprint import OrientedFrame, RectifiedFrame
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield.light_field import slice_mosaic
from dappled.decode.optics import Carrier, Lattice
from dappled.decode.spectrum import Slices
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError

Made = TypeVar("Made")
KEPT_BYTES = 24_000_000
SPECTRUM_PX = 880
SLICES_PX = 1600
_ALIKE = 0.05  # sensors whose sides differ by less have the same footprint


class Studio:
    """`views` and `refocused` are for one thread, all else may be used from another one at the same time. A frame is
    given as its `slices` message; `mount` leads from camera to body axes."""

    def __init__(self, recipe: Recipe | None, mount: Sequence[float]) -> None:
        self._darkroom = None if recipe is None else Darkroom(recipe)
        self._mount = mount
        self._kept: OrderedDict[tuple[Any, ...], Any] = OrderedDict()
        self._bytes = 0
        self._keeping = threading.Lock()

    def slices(self, message: Message) -> bytes:
        """The mosaic of the slices' magnitudes (Fig 43), JPEG."""
        return self._once(
            message,
            "slices",
            lambda: pictures.jpeg(
                slice_mosaic(_stack(message), np.array(message.header["carriers"]), longest_side=SLICES_PX), 82
            ),
        )

    def spectrum(self, message: Message) -> bytes:
        """The frame's spectrum where its slices cover it, JPEG; see `pictures.spectrum`."""

        def make() -> bytes:
            header = message.header
            tall, wide = header["frame_shape"]
            scale = SPECTRUM_PX / max(tall, wide)
            size = (round(tall * scale), round(wide * scale))
            return pictures.jpeg(pictures.spectrum(_stack(message), header["carriers"], header["grid"], size), 88)

        return self._once(message, "spectrum", make)

    def mean(self, message: Message, longest_side: int = 1280) -> bytes:
        """The slice of carrier (0, 0): the frame as a photograph without parallax, JPEG."""
        return self._once(
            message, f"mean {longest_side}", lambda: pictures.jpeg(pictures.shown(_mean(message, longest_side)))
        )

    def thumb(self, message: Message) -> NDArray[np.uint8]:
        """The same picture, small, uint8."""
        return pictures.shown(_mean(message, 256))

    def full(self, message: Message) -> NDArray[np.uint8]:
        """The same picture in full size, uint8."""
        return pictures.shown(_stack(message)[0].real)

    def views(self, message: Message) -> tuple[dict[str, Any], bytes]:
        """The mosaic of the views as JPEG, and its layout: size and place of each view, the source of the phases,
        and the lens' aperture in disparities.

        Raises DappledError for a frame without views.
        """

        def make() -> tuple[dict[str, Any], bytes]:
            made, source = self._mosaic(message)
            layout = {
                "tile": list(made.tile),
                "scale": made.scale,
                "row_steps": np.round(made.row_steps, 6).tolist(),
                "column_steps": np.round(made.column_steps, 6).tolist(),
                "source": source,
                "aperture": self._aperture(message.header, made),
            }
            return layout, pictures.jpeg(made.picture, 92)

        return self._once(message, "views", make)

    def refocused(self, message: Message, disparity: float) -> bytes:
        """The frame focused on a disparity, in pixels of a view from view to view, JPEG. For browsers without WebGL."""
        return pictures.jpeg(pictures.refocused(self._mosaic(message)[0], disparity))

    def depth(self, message: Message) -> bytes:
        """The picture of a `depth` message in colours, PNG."""
        arrays = message.arrays()
        return self._once(
            message,
            "depth",
            lambda: pictures.png(pictures.depth_colours(arrays["disparity"], arrays.get("sigma"))),
        )

    def corners(self, header: Mapping[str, Any]) -> list[tuple[float, float]] | None:
        """A frame's footprint; see `footprint.corners`. None where it is unknown."""
        one = self._oriented(header)
        return None if one is None else footprint.corners(one)

    def rectified(
        self, header: Mapping[str, Any], picture: NDArray[np.uint8], longest_side: int
    ) -> RectifiedFrame | None:
        """A frame's picture on the ground, north up; None where its position is unknown."""
        one = self._oriented(header)
        return None if one is None else footprint.rectify(one, picture, longest_side)

    def _oriented(self, header: Mapping[str, Any]) -> OrientedFrame | None:
        try:
            camera = profiles.camera(header["camera"])
        except DappledError:
            return None  # the chip of a body without a profile is unknown
        return oriented_frame(header["pose"], self._chip(camera, header), header["focal_length_mm"], self._mount)

    def _chip(self, camera: profiles.CameraProfile, header: Mapping[str, Any]) -> tuple[float, float] | None:
        shape = header.get("frame_shape")
        known = [raw.sensor.size_mm for raw in camera.raw if shape is None or list(raw.sensor.shape) == list(shape)]
        return known[0] if known and np.allclose(known, known[0], rtol=_ALIKE) else None  # until it is decoded

    def _mosaic(self, message: Message) -> tuple[Mosaic, str]:
        def make() -> tuple[Mosaic, str]:
            field = self._light_field(message)
            return pictures.views_mosaic(ViewStack.of(field)), str(field.attributes["views_from"])

        return self._once(message, "mosaic", make)

    def _aperture(self, header: Mapping[str, Any], made: Mosaic) -> float | None:
        """The lens' aperture as a disparity, for the α of Eq 28; None where lens or camera are unknown."""
        try:
            sensor = profiles.camera(header["camera"]).sensor(tuple(header["frame_shape"]))
        except DappledError:
            return None
        aperture, one = sensor.aperture_px(header["focal_length_mm"], header["f_number"]), made.sensor_px_per_disparity
        return aperture / one if aperture and one else None

    def _light_field(self, message: Message) -> LightField:
        header = message.header
        if self._darkroom is None:
            raise DappledError("no mask is configured: frames are not decoded")
        if self._darkroom.recipe.mask == profiles.LENSLET:
            raise DappledError("the views of a lenslet frame are made after the flight: dappled decode")
        rows, columns = header["frame_shape"]
        decoder = self._darkroom.decoder((rows, columns), header["camera"], colours=header["mosaic"])
        assert isinstance(decoder, MaskDecoder)
        orders = np.array([row[:2] for row in header["carriers"]])
        frequencies = np.array([row[2:] for row in header["carriers"]])
        vectors, *_ = np.linalg.lstsq(orders, frequencies, rcond=None)
        grid = np.array(header["grid"])
        slices = Slices(
            _stack(message),
            tuple(Carrier(int(ky), int(kx), fy, fx) for ky, kx, fy, fx in header["carriers"]),
            grid,
            float(1 / (grid[0, 0] * grid[1, 1])),
        )
        made = decoder.views(
            slices,
            Lattice(tuple(vectors[0].tolist()), tuple(vectors[1].tolist())),
            header["carriers_from"],
            focal_length_mm=header["focal_length_mm"],
            f_number=header["f_number"],
            noise_rms=header["noise_rms"] or 0.0,
        )
        if not made.values.size:
            raise DappledError(
                "this frame has no views: without a calibration, its f-number and visible carriers are needed"
            )
        carriers = np.array(header["carriers"])
        return LightField(slices.values, carriers, made.values, made.offsets, grid, {"views_from": made.source})

    def _once(self, message: Message, kind: str, make: Callable[[], Made]) -> Made:
        key = (message.header["flight"], message.header["frame"], kind)
        with self._keeping:
            if key in self._kept:
                self._kept.move_to_end(key)
                found: Made = self._kept[key]
                return found
        made = make()
        with self._keeping:
            self._kept[key] = made
            self._bytes += _size(made)
            while self._bytes > KEPT_BYTES and len(self._kept) > 1:
                self._bytes -= _size(self._kept.popitem(last=False)[1])
        return made


def _stack(message: Message) -> NDArray[np.complex64]:
    stack: NDArray[np.complex64] = message.arrays()["slices"]
    return stack


def _mean(message: Message, longest_side: int) -> NDArray[np.float32]:
    return pictures.small(_stack(message)[0].real, longest_side)


def _size(made: Any) -> int:
    parts = made if isinstance(made, tuple) else (made,)
    sizes = (
        part.picture.nbytes if isinstance(part, Mosaic) else len(part) if isinstance(part, bytes) else 200
        for part in parts
    )
    return sum(sizes)
