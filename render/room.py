"""Room for the entries of the tiles' lists, carried from frame to frame, so that no frame waits for a count from the device.

How many entries a picture has is known where it is drawn, on a GPU long after the host has gone on. To ask for it would hold the host up
in every frame. So a device sets aside what earlier frames needed, and some; entries beyond that are left out, and the count is looked at
one frame later. A frame that lacked some is drawn again, before anybody sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import torch

Job = TypeVar("Job")
Drawn = TypeVar("Drawn")

SPARE = 1.3
"""Of what a frame needed, what is set aside from then on."""


@dataclass(frozen=True)
class Asked:
    """Counts on their way to the host, and how many entries there was room for."""

    entries: int
    counts: list[torch.Tensor]
    arrived: torch.cuda.Event | None


class Room:
    """entries: how many a window's lists may have together; it grows, and never shrinks."""

    def __init__(self, entries: int = 1 << 20):
        self.entries = entries
        self._needed: list[torch.Tensor] = []

    def note(self, needed: torch.Tensor) -> None:
        """A list will need so many entries; int64, on the device."""
        self._needed.append(needed)

    def noted(self) -> list[torch.Tensor]:
        """What was noted since this was last asked for."""
        needed, self._needed = self._needed, []
        return needed

    def ask(self, needed: list[torch.Tensor]) -> Asked:
        """Send the counts on their way, without waiting for them."""
        if not needed or needed[0].device.type != "cuda":
            return Asked(self.entries, needed, None)
        counts = [torch.empty(n.shape, dtype=n.dtype, pin_memory=True).copy_(n, non_blocking=True) for n in needed]
        arrived = torch.cuda.Event()
        arrived.record(torch.cuda.current_stream(needed[0].device))
        return Asked(self.entries, counts, arrived)

    def held(self, asked: Asked) -> bool:
        """Whether there was room for everything; where not, there will be. Waits for the counts."""
        if asked.arrived is not None:
            asked.arrived.synchronize()
        most = max((int(count) for count in asked.counts), default=0)
        if most > self.entries:
            self.entries = min(int(SPARE * most), 2**31 - 1)
        if most >= 2**31:
            raise ValueError(f"a picture has {most} entries of tiles, too many to draw at once; draw it without a room, window by window")
        return most <= asked.entries


def one_ahead(draw: Callable[[Job], Drawn], jobs: Iterable[Job], room: Room) -> Iterator[Drawn]:
    """What `draw` makes of each job in `room`, each given out once the next has begun and it is known to lack nothing."""

    def whole(job: Job, drawn: Drawn, asked: Asked) -> Drawn:
        while not room.held(asked):
            drawn = draw(job)
            asked = room.ask(room.noted())
        return drawn

    waiting = None
    for job in jobs:
        begun = (job, draw(job), room.ask(room.noted()))
        if waiting is not None:
            yield whole(*waiting)
        waiting = begun
    if waiting is not None:
        yield whole(*waiting)
