"""The process that reads a log of PX4 with pyulog: see `reader_process`. Its words are the topics that are wanted.

A few hundred bytes of formats within formats take pyulog gigabytes, and in some damaged files it goes back for ever.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import Any

from dappled.drivers import reader_process
from dappled.drivers.reader_process import ReadArrays

_MOST_FIELDS = 10_000  # of a topic; PX4's have some hundreds


class FieldsError(Exception):
    """A topic has too many fields. No ValueError, which pyulog takes for damage, and goes on."""


def _answer(path: str, words: Sequence[str]) -> ReadArrays:
    """The fields of each topic's instances, as `topic/instance/field`. A log that was cut off is read up to there."""
    from pyulog import ULog  # noqa: PLC0415  # only the process itself loads it

    class Bounded(ULog._MessageAddLogged):  # type: ignore[misc]  # pyulog has no types
        def _parse_nested_type(self, *given: Any) -> None:
            if len(self.field_data) > _MOST_FIELDS:
                raise FieldsError(f"its topic {self.message_name[:80]!r} has more than {_MOST_FIELDS} fields")
            super()._parse_nested_type(*given)

    ULog._MessageAddLogged = Bounded
    try:
        log = ULog(path, list(words))
    except OSError as error:
        if error.errno != errno.EINVAL:  # pyulog seeks to before the start of a file in which nothing makes sense
            raise
        raise ValueError("cut off, or not one") from None
    topics = {(one.name, one.multi_id): one.data for one in reversed(log.data_list)}
    return (
        (f"{name}/{instance}/{field}", values)
        for (name, instance), data in topics.items()
        for field, values in data.items()
    ), ""


if __name__ == "__main__":
    reader_process.serve(_answer, "pyulog")
