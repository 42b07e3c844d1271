"""Several things at once, as they are learnt from and worked on: tensors that go to a device together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, TypeVar

import torch

T = TypeVar("T", bound="Batch")


class Batch:
    """A frozen dataclass of tensors and other batches, that goes to a device as one."""

    def each(self: T, change: Callable[[Any], Any]) -> T:
        """With every tensor changed."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]  # the subclasses are dataclasses
        return replace(self, **{k: v.each(change) if isinstance(v, Batch) else change(v) for k, v in values.items()})  # type: ignore[type-var]

    def pin_memory(self: T) -> T:
        """Under the name that torch's loader asks for: from pinned memory a copy to the GPU does not wait for it."""
        return self.each(torch.Tensor.pin_memory)

    def to(self: T, device: torch.device) -> T:
        return self.each(lambda x: x.to(device, non_blocking=True))
