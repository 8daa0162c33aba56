"""Find the key that signs a flight's seals, for the verbs that write into a flight."""

from __future__ import annotations

from pathlib import Path

from dappled.cli.table import words_only
from dappled.config import settings

if not words_only:
    from dappled.flight import seal_key
    from dappled.flight.seal_key import SealKey


def key_of(config: Path | None, given: Path | None = None) -> SealKey | None:
    """The key in the file that is `given`, else the one that a settings file names as record.seal_key; None where it
    names none. Raises ConfigError, and KeyFileError where the key can't be read."""
    file = given or settings.load(config).record.seal_key
    return seal_key.load(Path(file)) if file else None
