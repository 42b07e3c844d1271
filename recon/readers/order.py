"""The order in which files were recorded, and what they have in common, as their names tell it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import PurePosixPath

NUMBER = re.compile(r"([0-9]+(?:\.[0-9]+)?)")


def recorded(name: str) -> tuple:
    """A key that sorts names by the numbers in them: frame9.jpg before frame10.jpg, 12.5.jpg (seconds) after 12.45.jpg."""
    parts = NUMBER.split(name)  # text and numbers by turns
    return tuple(Decimal(part) if i % 2 else part for i, part in enumerate(parts)), name


def names_apart(taken: Mapping[int, Sequence[str]]) -> dict[int, str] | None:
    """What the names of each camera's pictures call it: their folder, else the words that all of them have and not all cameras' do, which
    one camera may lack. None where they tell no cameras apart."""
    folders = [{str(PurePosixPath(name).parent) for name in names} for names in taken.values()]
    flat = [re.sub(r"\W", "_", next(iter(some))) for some in folders if some != {"."} and len(some) == 1]
    if len(set(flat)) == len(taken):
        return dict(zip(taken, flat, strict=True))
    words = {key: shared_words(names) for key, names in taken.items()}
    common = set.intersection(*map(set, words.values()))
    told = {key: "_".join(word for word in some if word not in common) for key, some in words.items()}
    return {key: name or f"camera_{key}" for key, name in told.items()} if len(set(told.values())) == len(taken) else None


def shared_words(names: Sequence[str]) -> tuple[str, ...]:
    """The words that all of these files' names have at the same place: frame and left of frame_001_left.jpg and frame_002_left.jpg."""
    split = [[token for part in PurePosixPath(n).with_suffix("").parts for token in (*NUMBER.split(part), "/")] for n in names]
    if len({len(parts) for parts in split}) > 1:
        return ()
    same = "".join(parts[0] if len(set(parts)) == 1 else " " for parts in zip(*split, strict=True))
    return tuple(word for word in re.split(r"[\W_]+", same) if any(letter.isalpha() for letter in word))
