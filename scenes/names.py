"""Names: the sentence that says that one does not exist, with the nearest that does; and a class's as a folder's. Pure Python."""

import difflib
import re
from collections.abc import Iterable
from pathlib import Path

MANY, FEW = 20, 6
"""Names from which on not all are told, and how many of them are then."""


def nearest(name: str, options: Iterable[str]) -> str:
    """' Did you mean x?' for the option closest in spelling to `name`, or ''."""
    best = max(options, key=lambda option: _likeness(name, option), default="")
    return f" Did you mean {best}?" if _likeness(name, best) >= 0.5 else ""


def _likeness(name: str, option: str) -> float:
    """0 to 1: how like an option, or one of its words, a name is; so that "frnt" is nearer to front_camera than to left."""
    parts = [option, *re.split(r"[\W_]+", option)]
    return max(difflib.SequenceMatcher(None, name.casefold(), part.casefold()).ratio() for part in parts)


def unknown(kind: str, name: str, where: str, options: Iterable[str], each: str | None = None) -> str:
    """The house's sentence for a name that does not exist: what, where, what there is, the nearest; of many only those likest to it.
    each: where an option takes one name and may be repeated, how it takes one, as "--remove {}": so several are to be given."""
    parts = [part.strip() for part in name.split(",") if part.strip()]
    if each and len(parts) > 1:
        return f'{kind} "{name}" is not in {where}; if these are several, repeat the option: {" ".join(each.format(p) for p in parts)}'
    options = list(options)
    have = ", ".join(options) or "nothing"
    if len(options) > MANY:
        likest = sorted(options, key=lambda option: -_likeness(name, option))[:FEW]
        have = f"{len(options)}, the closest of which are {', '.join(likest)}"
    return f'{kind} "{name}" is not in {where}; it has {have}.{nearest(name, options)}'


def absent(path: Path) -> str:
    """The same of a path, with the nearest that stands beside where it would be."""
    beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
    return f"{path} does not exist.{nearest(path.name, beside)}"


def slug(label: str) -> str:
    """The class folder of a label: "Car" -> car, "Pedestrian with Object" -> pedestrian-with-object."""
    return re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-") or "thing"
