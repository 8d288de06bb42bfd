"""What stands in the fields of NMEA sentences: numbers, times and dates, None where they are none.

Most fields of an epoch are those of the one before, so the last few are remembered.
"""

import re
from datetime import UTC, datetime
from functools import lru_cache

NS_PER_S = 1_000_000_000

_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)")


@lru_cache(maxsize=256)
def number(text: bytes, low: float, high: float) -> float | None:
    """A decimal number within limits."""
    if not _NUMBER.fullmatch(text):
        return None
    value = float(text)
    return value if low <= value <= high else None


@lru_cache(maxsize=64)
def integer(text: bytes) -> int | None:
    """Up to four digits."""
    return int(text) if text.isdigit() and len(text) <= 4 else None


def time_of_day_ns(text: bytes) -> int | None:
    """Of hhmmss and any number of decimals."""
    minute_ns, second_ns, decimals_ns = _minute_of_day_ns(text[:4]), _second_ns(text[4:6]), _decimals_ns(text[6:])
    if minute_ns is None or second_ns is None or decimals_ns is None:
        return None
    return minute_ns + second_ns + decimals_ns


@lru_cache(maxsize=8)
def _minute_of_day_ns(text: bytes) -> int | None:
    if len(text) != 4 or not text.isdigit():
        return None
    hour, minute = int(text[:2]), int(text[2:])
    return None if hour > 23 or minute > 59 else (hour * 60 + minute) * 60 * NS_PER_S


@lru_cache(maxsize=64)
def _second_ns(text: bytes) -> int | None:
    if len(text) != 2 or not text.isdigit():
        return None
    second = int(text)  # a leap second is 23:59:60, the same instant as 0:00 of the next day
    return None if second > 60 else second * NS_PER_S


@lru_cache(maxsize=64)
def _decimals_ns(text: bytes) -> int | None:
    if text in (b"", b"."):
        return 0
    return int(text[1:10].ljust(9, b"0")) if text[:1] == b"." and text[1:].isdigit() else None


@lru_cache(maxsize=8)
def short_date_ns(text: bytes) -> int | None:
    """Begin of the day ddmmyy, UTC."""
    return date_ns(text[:2], text[2:4], text[4:])


@lru_cache(maxsize=8)
def date_ns(day: bytes, month: bytes, year: bytes) -> int | None:
    """Begin of the day, UTC; years of two digits are those from 1980 to 2079."""
    if not (day.isdigit() and month.isdigit() and year.isdigit() and len(year) in (2, 4)):
        return None
    full_year = int(year) if len(year) == 4 else int(year) + (2000 if int(year) < 80 else 1900)
    try:
        date = datetime(full_year, int(month), int(day), tzinfo=UTC)
    except ValueError:
        return None
    return int(date.timestamp()) * NS_PER_S
