"""The axes of a frame by name, as "y" and "-z". The names alone load nothing heavy."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

AXES = ("x", "-x", "y", "-y", "z", "-z")


def axis(name: str, option: str) -> np.ndarray:
    """The unit vector `[3]` of an axis; ValueError that names the option where it is none."""
    import numpy as np

    if name not in AXES:
        raise ValueError(f'--{option} "{name}" is not an axis; it is one of {", ".join(AXES)}')
    return np.eye(3)["xyz".index(name[-1])] * (-1.0 if name.startswith("-") else 1.0)


def upright(up: str) -> np.ndarray:
    """A rotation `[3, 3]` that turns the axis `up` to z, and none where it is z."""
    import numpy as np

    z = axis(up, "up")
    # of the axes after it in the cycle x, y, z the one becomes x, the other y, so that z is left as it is
    x = np.roll(np.abs(z), 1)
    return np.stack([x, np.cross(z, x), z])
