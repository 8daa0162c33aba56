"""Errors of decoding."""

from __future__ import annotations

from dappled.errors import DappledError
from dappled.findings import Finding


class DecodeError(DappledError, ValueError):
    """A frame can't be decoded as asked; one clear sentence: what, where, what to do."""


class NoCarriers(DecodeError):  # noqa: N818  # a finding, not a fault, as below
    """A frame, shot at `focal_length_mm` and `f_number`, shows no carriers of a mask.

    `expected`: they must be visible in it, whatever shape the stop has.
    """

    finding: Finding

    def __init__(self, finding: Finding, *, expected: bool, focal_length_mm: float, f_number: float) -> None:
        super().__init__(finding)
        self.expected = expected
        self.focal_length_mm = focal_length_mm
        self.f_number = f_number
