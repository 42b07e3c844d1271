"""Which view a fit looks at next."""

from __future__ import annotations

import torch


class Turns:
    """Draws places `0..V-1`, each as often as its weight says, so that none waits for long. due: draws that each is behind."""

    def __init__(self, weights: torch.Tensor, generator: torch.Generator):
        self.shares, self.generator = weights / weights.sum(), generator
        # from anywhere, or views of equal weight would come all at once
        self.due = torch.rand(len(weights), generator=generator)

    def next(self) -> int:
        """The one that is most overdue, or nearly."""
        self.due = self.due + self.shares  # anew: a checkpoint may hold the other
        k = int((self.due + 0.5 * torch.rand(len(self.due), generator=self.generator)).argmax())
        self.due[k] -= 1
        return k
