"""What may be otherwise about a recorded drive: each a function that gives the drive as it would have been recorded then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from recon.log import Log


@dataclass(frozen=True)
class Change:
    """A drive otherwise.

    make: the drive as recorded -> otherwise. clock: how long a second of the recording lasts then. spoilt: what it makes worse than
    recorded of that by which a scene is measured: "boxes", the "path" that everything lies along, or nothing ("").
    """

    make: Callable[[Log], Log]
    clock: float = 1.0
    spoilt: str = ""

    @property
    def what(self) -> str:
        """In words."""
        return (self.make.__doc__ or "").split(".\n")[0].rstrip(".")


CHANGES: dict[str, Change] = {}
"""By name."""


def change(clock: float = 1.0, spoilt: str = "") -> Callable[[Callable[[Log], Log]], Callable[[Log], Log]]:
    """Puts a function into `CHANGES`; its docstring is what tables say of it."""

    def put(make: Callable[[Log], Log]) -> Callable[[Log], Log]:
        CHANGES[make.__name__.replace("_", " ")] = Change(make, clock, spoilt)
        return make

    return put


@change()
def as_it_is(log: Log) -> Log:
    """Nothing is otherwise."""
    return log
