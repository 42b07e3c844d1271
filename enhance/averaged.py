"""What is measured of pictures, and averaged over several of them or over the frames of a clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Self

import torch


class Averaged:
    """A frozen dataclass of tensors."""

    @classmethod
    def mean_of(cls, several: Sequence[Self]) -> Self:
        return cls(*(torch.stack(tensors).mean(0) for tensors in zip(*map(_tensors, several), strict=True)))

    def toward(self, other: Self, share: float) -> Self:
        """The mean of both, of which `other` is such a share."""
        return type(self)(*(torch.lerp(mine, theirs, share) for mine, theirs in zip(_tensors(self), _tensors(other), strict=True)))


def _tensors(measured: Averaged) -> list[torch.Tensor]:
    return [getattr(measured, f.name) for f in fields(measured)]  # type: ignore[arg-type]  # the subclasses are dataclasses
