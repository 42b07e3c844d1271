"""The axes of a frame by name, as "y" and "-z"."""

from __future__ import annotations

import numpy as np

AXES = {name: np.eye(3)[i] * sign for i, letter in enumerate("xyz") for name, sign in ((letter, 1.0), (f"-{letter}", -1.0))}


def axis(name: str, option: str) -> np.ndarray:
    """The unit vector `[3]` of an axis; ValueError that names the option where it is none."""
    if name not in AXES:
        raise ValueError(f'--{option} "{name}" is not an axis; it is one of {", ".join(AXES)}')
    return AXES[name]


def upright(up: str) -> np.ndarray:
    """A rotation `[3, 3]` that turns the axis `up` to z, and none where it is z."""
    z = axis(up, "up")
    # of the axes after it in the cycle x, y, z the one becomes x, the other y, so that z is left as it is
    x = np.roll(np.abs(z), 1)
    return np.stack([x, np.cross(z, x), z])
