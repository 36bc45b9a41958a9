"""What the stamps of tables mean: numbers in a unit of time, or ISO 8601 times, from an origin on.

Stamps and origin are subtracted as decimal numbers, so that a stamp of nanoseconds since 1970, of
19 digits, keeps all of them.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from decimal import Context, Decimal, InvalidOperation
from functools import lru_cache

UNITS = {"s": 0, "ms": -3, "us": -6, "ns": -9}
"""The exponent of ten of each unit of stamps, in seconds."""
EXACT = Context(prec=80, traps=[InvalidOperation])
"""Arithmetic of stamps: far more digits than they have."""
EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_FRACTION = re.compile(r"[Tt ](?:\d{2}:\d{2}:\d{2}|\d{6})[.,](\d+)")
_PLAIN = re.compile(r"[+-]?\d+(?:\.(\d*))?")
_SECOND = datetime.timedelta(seconds=1)


@dataclass(frozen=True)
class TimeBase:
    """What the stamps of tables mean.

    unit    "s", "ms", "us" or "ns": of stamps that are numbers; ISO 8601 times are seconds since
            1970 (UTC where they name no zone)
    origin  the stamp, in seconds, of simulated 0
    """

    unit: str = "s"
    origin: Decimal = Decimal(0)

    def seconds(self, text: str) -> float:
        """Return the seconds of the stamp ``text``, rounded once; ValueError for other texts."""
        if self.unit == "s" and not self.origin and "_" not in text:
            # The common case: the value is the number as it stands.
            try:
                return float(text)
            except ValueError:
                pass
        return float(EXACT.subtract(self.exact(text), self.origin))

    def text(self, seconds: float) -> str:
        """Return the stamp of a simulated time: ``seconds`` reads it as this time, to the bit."""
        stamp = EXACT.add(Decimal(repr(seconds)), self.origin).scaleb(-UNITS[self.unit], EXACT)
        return f"{stamp:f}" if self.origin or self.unit != "s" else repr(seconds)

    def half_digit(self, text: str) -> float:
        """Return half of the last digit of the stamp ``text``, in seconds: how far the instant may
        be from it if it was rounded. An origin that has as few digits adds its own.
        """
        plain = _PLAIN.fullmatch(text)
        if plain is not None:
            return self._half_digit(UNITS[self.unit] - len(plain.group(1) or ""))
        return self._half_digit(_last_digit(self.exact(text)))

    @lru_cache(maxsize=64)  # noqa: B019 - bases are few and small
    def _half_digit(self, exponent: int) -> float:
        """Return half of the last digit of a stamp that is 10 to this ``exponent``."""
        own = 0.5 * 10.0**exponent
        return own + 0.5 * 10.0 ** min(exponent, _last_digit(self.origin)) if self.origin else own

    def exact(self, text: str) -> Decimal:
        """Return the stamp in seconds, not counted from the origin; raises ValueError."""
        if "_" in text:  # Python takes 1_000 for a number
            raise ValueError(text)
        try:
            number = EXACT.create_decimal(text.strip())
        except InvalidOperation:
            return parse_iso(text)
        if not number.is_finite():
            raise ValueError(text)
        return number.scaleb(UNITS[self.unit], EXACT)


def _last_digit(number: Decimal) -> int:
    """Return the exponent of ten of the last digit that the number is written with."""
    exponent = number.as_tuple().exponent
    return max(-99, min(exponent, 99)) if isinstance(exponent, int) else 0


def parse_iso(text: str) -> Decimal:
    """Return the seconds since 1970 of an ISO 8601 time with any number of decimals, in UTC where
    it names no zone; raises ValueError for other texts.
    """
    time = datetime.datetime.fromisoformat(text.strip())
    if time.tzinfo is None:
        time = time.replace(tzinfo=datetime.UTC)
    # datetime has microseconds only: the decimals are read from the text.
    whole, rest = divmod(time.replace(microsecond=0) - EPOCH, _SECOND)
    if rest:
        raise ValueError(text)
    fraction = _FRACTION.search(text)
    if fraction is None and re.search("[.,]", text):
        raise ValueError(text)  # a fraction of a minute, or of a zone
    return EXACT.add(Decimal(whole), Decimal(f"0.{fraction.group(1)}" if fraction else 0))
