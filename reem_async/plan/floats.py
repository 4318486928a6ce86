"""Decimal text for floats that RedisJSON reads back bit for bit.

RedisJSON parses numbers quickly: it collects up to 64 bits of digits, then multiplies or divides once by a power of
ten. That is off by one unit in the last place for one long decimal in nine. Since the procedure is known, digits and
exponent can be chosen so that its one rounding gives the wanted float, and so does a correctly rounding parser. For
about two floats in a thousand no such text exists; those are stored in hexadecimal, see `placeholders`.
"""

from __future__ import annotations

import math
import re

import numpy as np

_POWERS = tuple(float(f"1e{k}") for k in range(309))
_POWERS_ARRAY = np.array(_POWERS[:23])
_EXACT_PLACES = 22  # the largest power of ten that is a float itself: up to there all parsers agree
_LIMIT = 2**64
_LOG2_OF_10 = math.log2(10.0)

# Up to 15 significant digits with a small exponent are parsed exactly. These find longer ones. Both begin with a
# literal character, which the regular expression engine finds at memory speed.
_LONG = re.compile(rb"\.(?:\d{6}|(?<=\d{10}\.)\d)")
_EXPONENT = re.compile(rb"e[-+]\d")


def may_lose(text: bytes) -> bool:
    """Return whether JSON `text` may hold a float that RedisJSON would change. False is certain."""
    return (b"." in text and _LONG.search(text) is not None) or (
        (b"-" in text or b"+" in text) and _EXPONENT.search(text) is not None
    )


def exact_text(value: float) -> bytes | None:
    """Return JSON text that RedisJSON parses to exactly `value`, or None where there is none.

    `value` must be finite. The text is not the shortest: the server stores the number, not the text.
    """
    size = abs(value)
    places = _places(math.frexp(size)[1])
    if size and 0 <= places <= _EXACT_PLACES - 2:
        for tried in (places, places + 1, places + 2):
            scaled = size * _POWERS[tried]
            if scaled / _POWERS[tried] == size and scaled < _LIMIT:
                return b"%de-%d" % (math.copysign(scaled, value), tried)
    return _rare_text(value)


def exact_list(values: list[float]) -> list[bytes | None]:
    """Return what `exact_text` returns for each of many finite floats, at a third of the time."""
    array = np.array(values)
    sizes = np.abs(array)
    places = np.ceil((54 - np.frexp(sizes)[1]) / _LOG2_OF_10).astype(np.int64)
    usual = (places >= 0) & (places <= _EXACT_PLACES) & (sizes > 0)
    powers = _POWERS_ARRAY[np.where(usual, places, 0)]
    scaled = array * powers
    usual &= scaled / powers == array
    # `_places` aims at 53 to 58 bits, so no digits are lost in an int64.
    digits = np.where(usual, scaled, 0.0).astype(np.int64).tolist()
    return [
        b"%de-%d" % (digit, place) if fine else exact_text(value)
        for digit, place, fine, value in zip(digits, places.tolist(), usual.tolist(), values, strict=True)
    ]


def _places(bits: int) -> int:
    """Return the power of ten that makes a float of this binary exponent an integer of 53 to 58 bits."""
    return math.ceil((54 - bits) / _LOG2_OF_10)


def _rare_text(value: float) -> bytes | None:
    """Return the exact text of a float that is very large or small, or that usual scaling misses."""
    size = abs(value)
    digits, exponent = _shortest(size)
    if _as_parsed(digits, exponent) == size:
        return repr(value).encode()
    found = _search(size)
    if found is None:
        return None
    return b"%s%de%d" % (b"-" if value < 0 else b"", *found)


def _shortest(size: float) -> tuple[int, int]:
    mantissa, _, power = repr(size).partition("e")
    whole, _, fraction = mantissa.partition(".")
    return int(whole + fraction), int(power or 0) - len(fraction)


def _as_parsed(digits: int, exponent: int) -> float:
    """Return what RedisJSON makes of `digits`e`exponent`; digits below 2**64."""
    result = float(digits)
    while exponent < -308:
        result /= 1e308
        exponent += 308
    if exponent > 308:
        return math.inf if digits else 0.0
    return result * _POWERS[exponent] if exponent >= 0 else result / _POWERS[-exponent]


def _search(size: float) -> tuple[int, int] | None:
    """Return digits and exponent that are parsed to `size`, trying each possible power of ten."""
    bits = math.frexp(size)[1]
    first = int((53 - bits) / _LOG2_OF_10)
    for places in range(first - 2, first + 6):
        scaled = _scale(size, places)
        if not 1 <= scaled < _LIMIT:
            continue
        # `_scale` rounds too, so the neighbours are tried as well.
        for near in (scaled, math.nextafter(scaled, 0.0), math.nextafter(scaled, math.inf)):
            digits = int(near)
            if digits < _LIMIT and _as_parsed(digits, -places) == size and float(f"{digits}e{-places}") == size:
                return digits, -places
    return None


def _scale(size: float, places: int) -> float:
    """Return size * 10**places, roughly, without overflow on the way."""
    if places > 308:
        return size * 1e308 * _POWERS[min(places - 308, 308)]
    return size * _POWERS[places] if places >= 0 else size / _POWERS[min(-places, 308)]
