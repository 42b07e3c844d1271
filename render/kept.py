"""What is dear to make from a tensor is kept beside it until it changes."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import torch
from torch.utils.weak import WeakIdRef, WeakTensorKeyDictionary

T = TypeVar("T")


def kept_beside(make: Callable[..., T]) -> Callable[..., T]:
    """A function of a tensor and more that remembers what it last made of that tensor: for as long as the tensor lives, nothing has been
    written to it, and what follows it is the same. What `make` gives back must not hold the tensor itself, which would never be dropped.
    Tensors made in inference mode do not tell when they are written to, so of these nothing is kept."""
    store = WeakTensorKeyDictionary()

    @wraps(make)
    def kept(tensor: torch.Tensor, *more) -> T:
        if any(t.is_inference() for t in (tensor, *more) if isinstance(t, torch.Tensor)):
            return make(tensor, *more)
        now = [tensor._version, *map(_state, more)]
        found = store.get(tensor)
        if found is None or found[0] != now:
            found = (now, make(tensor, *more))
            store[tensor] = found
        return found[1]

    return kept


def _state(value):
    return (WeakIdRef(value), value._version) if isinstance(value, torch.Tensor) else value
