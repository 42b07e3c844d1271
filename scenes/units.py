"""Quantities as people write them: "2m", "-3.5m", "5deg", "36km/h", "100ms". Pure Python: the front door needs it at once.

A quantity is a finite decimal number and a unit, with or without a space between. A bare number is refused, since nobody can
know what it means. All functions but `number` raise ValueError with the fix in the message.
"""

import math
import re

# unit -> (numerator, denominator) of the factor to the base unit: dividing by 100 rounds once, multiplying by 0.01 twice
_KINDS: dict[str, dict[str, tuple[float, float]]] = {
    "length": {"m": (1, 1), "cm": (1, 100), "mm": (1, 1000), "km": (1000, 1)},
    "angle": {"deg": (math.pi, 180), "rad": (1, 1)},
    "speed": {"m/s": (1, 1), "km/h": (1000, 3600)},
    "time": {"s": (1_000_000, 1), "ms": (1000, 1), "us": (1, 1)},
}
_FIX = {
    "length": ("{0}m (metres)", 100, "{0}cm"),
    "angle": ("{0}deg (degrees)", math.pi / 180, "{0}rad"),
    "speed": ("{0}m/s", 3.6, "{0}km/h"),
    "time": ("{0}s (seconds)", 1000, "{0}ms"),
}
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\s\d.]\S*)?\s*")


def length(text: str) -> float:
    """Metres: "2m", "200cm", "2000mm", "0.002km"."""
    return _parse(text, "length")


def angle(text: str) -> float:
    """Radians: "5deg", "0.1rad"."""
    return _parse(text, "angle")


def speed(text: str) -> float:
    """Metres a second: "8m/s", "30km/h"."""
    return _parse(text, "speed")


def duration_us(text: str) -> int:
    """Whole microseconds, the nearest: "2s", "100ms", "50us"."""
    value = _parse(text, "time")
    if abs(value) >= 2**63:
        raise ValueError(f'"{text}" is more microseconds than an int64 holds')
    return round(value)


def number(text: str) -> float:
    """A number without a unit, as Python writes it; NaN where it is none, which no bound holds."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _parse(text: str, kind: str) -> float:
    match = _QUANTITY.fullmatch(text)
    if not match:
        raise ValueError(f'"{text}" is not {_article(kind)}; write a number and a unit, as {_example(kind, 2)}')
    number, unit = match.groups()
    value = float(number)
    if unit is None:
        raise ValueError(f'"{text}" has no unit; write {_example(kind, value)}')
    units = _KINDS[kind]
    if unit not in units:
        other = next((k for k, names in _KINDS.items() if unit in names), None)
        what = f"is {_article(other)}, not {_article(kind)}" if other else f'has the unknown unit "{unit}"'
        raise ValueError(f'"{text}" {what}; {_article(kind)} is written in {", ".join(units)}, as {_example(kind, value)}')
    up, down = units[unit]
    value = value * up / down
    if not math.isfinite(value):
        raise ValueError(f'"{text}" is too large; write a finite number')
    return value


def _example(kind: str, value: float) -> str:
    """`value` in two units of its kind: "2m (metres) or 200cm"."""
    first, factor, second = _FIX[kind]
    return f"{first.format(f'{value:g}')} or {second.format(f'{value * factor:.4g}')}"


def _article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"
