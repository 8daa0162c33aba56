"""Errors of decoding."""

from __future__ import annotations

from dappled.errors import DappledError


class DecodeError(DappledError, ValueError):
    """A frame can't be decoded as asked; one clear sentence: what, where, what to do."""


class NoLattice(DecodeError):  # noqa: N818  # a finding, not a fault: the frame is fine, but has no lattice in it
    """The spectrum of a frame shows no lattice of carriers."""
