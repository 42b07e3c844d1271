"""Names that do not exist: the sentence that says so, and the nearest one that does. Pure Python."""

import difflib
from collections.abc import Iterable


def nearest(name: str, options: Iterable[str]) -> str:
    """' Did you mean x?' for the option closest in spelling to `name`, or ''."""
    close = difflib.get_close_matches(name, list(options), n=1, cutoff=0.4)
    return f" Did you mean {close[0]}?" if close else ""


def unknown(kind: str, name: str, where: str, options: Iterable[str]) -> str:
    """The house's sentence for a name that does not exist: what, where, what there is, the nearest."""
    options = list(options)
    have = ", ".join(options) or "nothing"
    return f'{kind} "{name}" is not in {where}; it has {have}.{nearest(name, options)}'
