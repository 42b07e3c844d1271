"""What is dear to make from a tensor is kept beside it until it changes."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import torch
from torch.utils.weak import WeakIdRef

T = TypeVar("T")


def kept_beside(make: Callable[..., T]) -> Callable[..., T]:
    """A function of a tensor and more that remembers what it last made of that tensor: for as long as the tensor lives, nothing has been
    written to it, and what follows it is the same. What `make` gives back must not hold the tensor itself, which would never be dropped.
    Tensors made in inference mode do not tell when they are written to, so of these nothing is kept."""
    store: dict[int, tuple[weakref.ref, list, T]] = {}

    @wraps(make)
    def kept(tensor: torch.Tensor, *more) -> T:
        if any(t.is_inference() for t in (tensor, *more) if isinstance(t, torch.Tensor)):
            return make(tensor, *more)
        key, now = id(tensor), [tensor._version, *map(_state, more)]
        found = store.get(key)
        if found is None or found[0]() is not tensor or found[1] != now:
            # an id is another's once its tensor is gone; this one's end takes away only what is its own
            found = (weakref.ref(tensor, lambda ended: _drop(store, key, ended)), now, make(tensor, *more))
            store[key] = found
        return found[2]

    return kept


def _drop(store: dict, key: int, ended: weakref.ref) -> None:
    found = store.get(key)
    if found is not None and found[0] is ended:
        del store[key]


def _state(value):
    return (WeakIdRef(value), value._version) if isinstance(value, torch.Tensor) else value
