"""Strict reading: every tensor that a layout names is there in its shape, and nothing else is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch

State = dict[str, torch.Tensor]
Shapes = Mapping[str, tuple[int, ...]]


def strict(path: Path, what: str, state: Mapping[str, object], wanted: Shapes, beside: str = "") -> State:
    """The tensors of `state` that `wanted` names.

    `beside` is a pattern of names that the releases write too and inference does not use; they may be there. ValueError names what is
    missing, unknown, misshapen or not a tensor of floats, and the fix.
    """
    missing = sorted(wanted.keys() - state.keys())
    unknown = sorted(name for name in state.keys() - wanted.keys() if not (beside and re.fullmatch(beside, name)))
    for names, verb in ((missing, "lacks"), (unknown, "has the unknown")):
        if names:
            raise ValueError(f"{path} {verb} {_listed(names)} of {what}, which has {len(wanted)} tensors; {_fix(what)}")
    found: State = {}
    for name, shape in wanted.items():
        value = state[name]
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise ValueError(f"{path}: {name} of {what} must be a tensor of floats, got {kind}; {_fix(what)}")
        if tuple(value.shape) != shape:
            raise ValueError(f"{path}: {name} of {what} has shape {tuple(value.shape)}, wanted {shape}; {_fix(what)}")
        found[name] = value
    return found


def fill(path: Path, what: str, module: torch.nn.Module, state: Mapping[str, object], assign: bool = True, beside: str = "") -> None:
    """Give a module of that layout the tensors of `state`, in float32 and copied: a mapped file may change. ValueError as `strict`."""
    wanted = {name: tuple(value.shape) for name, value in module.state_dict().items() if not (beside and re.fullmatch(beside, name))}
    found = strict(path, what, state, wanted, beside)
    module.load_state_dict({name: value.to(torch.float32, copy=True) for name, value in found.items()}, strict=False, assign=assign)


def finite(path: Path, module: torch.nn.Module) -> None:
    """ValueError where a weight is not finite."""
    for name, value in module.state_dict().items():
        if not torch.isfinite(value.sum(dtype=torch.float64)):
            raise ValueError(f"{path}: {name} holds values that are not finite; fetch the file again")


def part(state: Mapping[str, object], prefix: str) -> dict[str, object]:
    """What of `state` begins with `prefix`, without it."""
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def shape_of(path: Path, what: str, state: Mapping[str, object], name: str, sides: int) -> tuple[int, ...]:
    """The shape of the tensor that tells a layout's sizes. ValueError where it is not there or has not as many sides."""
    value = state.get(name)
    if not isinstance(value, torch.Tensor) or value.ndim != sides:
        raise ValueError(f"{path} lacks {name} of {what}; {_fix(what)}")
    return tuple(value.shape)


def _listed(names: Iterable[str]) -> str:
    names = list(names)
    more = f" and {len(names) - 3} others" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _fix(what: str) -> str:
    return f"fetch {what} again, as it was released"
