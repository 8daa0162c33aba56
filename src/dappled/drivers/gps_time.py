"""GPS time in UTC."""

from __future__ import annotations

from bisect import bisect_right
from datetime import UTC, datetime, timedelta

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
# From each of these days on GPS time is one second more ahead of UTC.
_LEAPS = ("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01",
          "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01",
          "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01")  # fmt: skip
_LEAP_STARTS = tuple(datetime.fromisoformat(day).replace(tzinfo=UTC) for day in _LEAPS)


def gps_to_utc(gps: datetime) -> datetime:
    """GPS time, written as a date, in UTC.

    >>> gps_to_utc(datetime(2026, 11, 21, 10, 15, 21, tzinfo=UTC)).isoformat()
    '2026-11-21T10:15:03+00:00'
    """
    seconds = bisect_right(_LEAP_STARTS, gps)
    utc = gps - timedelta(seconds=seconds)
    if seconds and utc < _LEAP_STARTS[seconds - 1]:  # within the seconds after a leap, that GPS time reaches first
        utc += timedelta(seconds=1)
    return utc
