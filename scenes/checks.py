"""Shape, dtype and value checks with messages that say what was expected and what came."""

import torch


def check_floats(name: str, image: torch.Tensor) -> None:
    """ValueError unless a picture holds floats: bytes are 0..255, and would be taken as white."""
    if not image.is_floating_point():
        raise ValueError(f"{name} must be floats in 0..1, got {image.dtype}; divide bytes by 255")


def check_tensor(name: str, value, shape: tuple, dtype: torch.dtype | None = None) -> None:
    """Raise ValueError unless `value` is a tensor of `shape`; a str in `shape` matches any size."""
    if isinstance(value, torch.Tensor) and value.ndim == len(shape) and (dtype is None or value.dtype == dtype):
        for wanted, size in zip(shape, value.shape, strict=True):  # a plain loop: a fit's step comes by here hundreds of times
            if wanted != size and not isinstance(wanted, str):
                break
        else:
            return
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} must be a torch tensor, got {type(value).__name__}")
    fits = value.ndim == len(shape) and all(isinstance(s, str) or s == n for s, n in zip(shape, value.shape, strict=True))
    if not fits:
        wanted = ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "")
        raise ValueError(f"{name} must have shape ({wanted}), got {tuple(value.shape)}")
    if dtype is not None and value.dtype != dtype:
        raise ValueError(f"{name} must be {dtype}, got {value.dtype}")
