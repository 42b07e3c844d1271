"""States of long work on disk: tensors and plain values, which `torch.load(..., weights_only=True)` reads back."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import torch

from scenes.atomic import atomic_file, clear_partials


def save_state(path: Path, state: dict) -> None:
    """Write a state; the former file stays until this one is whole, and what a killed run wrote half goes.

    OSError that names `path` where the disk is full.
    """
    whole = BytesIO()  # written by Python, which says that the disk is full; torch's own writer says "unexpected pos"
    torch.save(state, whole)
    clear_partials(path)
    with atomic_file(path) as half, open(half, "wb") as file:
        file.write(whole.getbuffer())
