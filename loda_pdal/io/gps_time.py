"""Days of measurement from the GPS time of LAS points."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
GPS_OFFSET_S = 1e9
"""LAS "adjusted standard" GPS time is seconds since `GPS_EPOCH` minus this."""
GPS_LEAP_S = 18.0
"""Seconds that GPS time is ahead of UTC since 2017."""


def gps_day(adjusted_s: float) -> str | None:
    """ISO date of an adjusted standard GPS time in seconds; None where it cannot be a lidar survey's."""
    if not np.isfinite(adjusted_s):
        return None
    try:
        day = (GPS_EPOCH + timedelta(seconds=adjusted_s + GPS_OFFSET_S - GPS_LEAP_S)).date()
    except OverflowError:
        return None
    return day.isoformat() if 1995 <= day.year <= datetime.now(tz=UTC).year + 1 and adjusted_s != 0 else None
