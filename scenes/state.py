"""States of long work on disk: tensors and plain values."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import torch

from scenes.atomic import FULL, atomic_file


def load_state(path: Path) -> dict:
    """What `save_state` wrote, on the CPU, since it may go on where there is no GPU. ValueError where it is something else, or damaged."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, MemoryError):
        raise
    except Exception as error:
        # damaged bytes end torch's unpickler in any way, and what it says of them is to load them as code
        raise ValueError("it is damaged, or something else") from error


def save_state(path: Path, state: dict) -> None:
    """Write a state; the former file stays until this one is whole.

    OSError that names `path` where the disk is full, with a note of how much room it takes beside the former file.
    """
    whole = BytesIO()  # written by Python, which says that the disk is full; torch's own writer says "unexpected pos"
    torch.save(state, whole)
    try:
        with atomic_file(path) as half, open(half, "wb") as file:
            file.write(whole.getbuffer())
    except OSError as error:
        if error.errno in FULL:
            error.add_note(f"it takes {whole.tell() / 1e6:.1f} MB")
        raise
