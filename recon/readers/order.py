"""The order in which files were recorded, as their names tell it."""

from __future__ import annotations

import re
from decimal import Decimal

NUMBER = re.compile(r"([0-9]+(?:\.[0-9]+)?)")


def recorded(name: str) -> tuple:
    """A key that sorts names by the numbers in them: frame9.jpg before frame10.jpg, 12.5.jpg (seconds) after 12.45.jpg."""
    parts = NUMBER.split(name)  # text and numbers by turns
    return tuple(Decimal(part) if i % 2 else part for i, part in enumerate(parts)), name
