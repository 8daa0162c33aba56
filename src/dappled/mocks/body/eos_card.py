"""The card and memory of a simulated Canon EOS 450D: folders and files by handle, read over PTP."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from dappled.mocks.body import ptp
from dappled.mocks.body.faults import BodyFaults
from dappled.mocks.body.ptp import Format, Handler, Op, PtpRequest, PtpResponse, ResponseCode

CARD_BYTES = 512 << 20
"""Room for about a hundred small frames: the card is in this process' memory."""
STORAGE = 0x00020001
DCIM = 0x20000000
FOLDER = 0x21900000


@dataclass(frozen=True, slots=True)
class StoredObject:
    """A folder or a file on the card, or (parent 0, handle below `DCIM`) a file in the body's memory."""

    handle: int
    parent: int
    name: str
    code: int
    data: bytes
    unix_s: int

    @property
    def taken(self) -> str:
        """The date as PTP writes it."""
        return time.strftime("%Y%m%dT%H%M%S", time.gmtime(self.unix_s))


class Card:
    """All objects of a body. The caller holds the body's lock. The fault "short" cuts an object's data."""

    def __init__(self, size: int, faults: BodyFaults, unix_s: int) -> None:
        self._size = size
        self._faults = faults
        self._frame_bytes = 0  # of the largest so far: room for one more like it is asked for
        folders = (
            StoredObject(DCIM, 0, "DCIM", Format.FOLDER, b"", unix_s),
            StoredObject(FOLDER, DCIM, "100CANON", Format.FOLDER, b"", unix_s),
        )
        self._objects = {each.handle: each for each in folders}

    @property
    def names(self) -> list[str]:
        """The files on the card, in order."""
        return [each.name for each in self._objects.values() if each.parent == FOLDER]

    def change(self) -> None:
        """Another card of this size takes its place, with a folder and no file."""
        self._objects = {handle: each for handle, each in self._objects.items() if handle in (DCIM, FOLDER)}

    @property
    def full(self) -> bool:
        """Whether there is no room for another frame like the largest."""
        return self._free() < max(self._frame_bytes, 1)

    def keep(self, files: Iterable[StoredObject]) -> None:
        """Put the files of one frame on the card, or into memory."""
        kept = {each.handle: each for each in files}
        self._objects |= kept
        self._frame_bytes = max(self._frame_bytes, sum(len(each.data) for each in kept.values()))

    @property
    def handlers(self) -> Mapping[int, Handler]:
        """The operations that are about objects and storage."""
        return {
            Op.GET_STORAGE_IDS: self._storage_ids,
            Op.EOS_GET_STORAGE_IDS: self._storage_ids,
            Op.GET_STORAGE_INFO: self._storage_info,
            Op.EOS_GET_STORAGE_INFO: self._storage_info,
            Op.GET_NUM_OBJECTS: self._count,
            Op.GET_OBJECT_HANDLES: self._handles,
            Op.GET_OBJECT_INFO: self._info,
            Op.EOS_GET_OBJECT_INFO_EX: self._folder,
            Op.GET_OBJECT: self._whole,
            Op.EOS_GET_OBJECT: self._whole,
            Op.GET_PARTIAL_OBJECT: self._part,
            Op.EOS_GET_PARTIAL_OBJECT: self._part,
            Op.GET_THUMB: self._no_thumb,
            Op.DELETE_OBJECT: self._delete,
            Op.EOS_DELETE_OBJECT: self._delete,
            Op.EOS_TRANSFER_COMPLETE: self._transferred,
        }

    def _free(self) -> int:
        used = sum(len(each.data) for each in self._objects.values())
        return max(self._size - used, 0)

    def _storage_ids(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(data=ptp.array32((STORAGE,)))

    def _storage_info(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(data=ptp.storage_info(self._size, self._free()))

    def _children(self, parent: int) -> list[StoredObject]:
        folder = 0 if parent == ptp.ROOT else parent
        return [each for each in self._objects.values() if each.parent == folder and each.handle >= DCIM]

    def _found(self, parent: int) -> list[StoredObject]:
        return list(self._objects.values()) if parent == 0 else self._children(parent)

    def _handles(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(data=ptp.array32(each.handle for each in self._found(request.parameter(2))))

    def _count(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(parameters=(len(self._found(request.parameter(2))),))

    def _info(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        found = self._objects.get(request.parameter(0))
        if found is None:
            return PtpResponse(ResponseCode.INVALID_OBJECT_HANDLE)
        return PtpResponse(
            data=ptp.object_info(
                storage=STORAGE,
                code=found.code,
                size=len(found.data),
                parent=found.parent,
                name=found.name,
                taken=found.taken,
            )
        )

    def _folder(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        rows = self._children(request.parameter(1))
        return PtpResponse(
            data=ptp.eos_folder(
                (each.handle, STORAGE, each.code, len(each.data), each.parent, each.name, each.unix_s) for each in rows
            )
        )

    def _whole(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        found = self._objects.get(request.parameter(0))
        if found is None:
            return PtpResponse(ResponseCode.INVALID_OBJECT_HANDLE)
        return PtpResponse(data=self._sent(found, 0, len(found.data)))

    def _part(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        found = self._objects.get(request.parameter(0))
        if found is None:
            return PtpResponse(ResponseCode.INVALID_OBJECT_HANDLE)
        piece = self._sent(found, request.parameter(1), request.parameter(2))
        return PtpResponse(parameters=(len(piece),), data=piece)

    def _sent(self, found: StoredObject, offset: int, count: int) -> memoryview:
        end = min(offset + count, len(found.data))
        if end == len(found.data) and self._faults.take("short"):
            end = max(end - 1024, offset)
        return memoryview(found.data)[offset:end]

    def _no_thumb(self, _request: PtpRequest, _data: bytes) -> PtpResponse:
        return PtpResponse(ResponseCode.NO_THUMBNAIL_PRESENT)

    def _delete(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        found = self._objects.pop(request.parameter(0), None)
        return PtpResponse(ResponseCode.INVALID_OBJECT_HANDLE) if found is None else PtpResponse()

    def _transferred(self, request: PtpRequest, _data: bytes) -> PtpResponse:
        """The file has been fetched: free its memory."""
        if request.parameter(0) < DCIM:
            self._objects.pop(request.parameter(0), None)
        return PtpResponse()
