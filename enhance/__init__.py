"""A frame becomes a better frame: degradations, pairs, the network, its training, enhancement, evaluation.

Images are display-referred sRGB float32 `[H, W, 3]` in 0..1 at this package's border and `[B, 3, H, W]` inside it.
Names are loaded when first used, so that `import enhance` costs nothing.
"""

import importlib

_HOME = {
    "Enhancer": "enhancer",
    "Memory": "enhancer",
    "enhance_video": "clip",
    "Isp": "isp",
    "random_isp": "isp",
    "make_pairs": "pairs",
    "PairSet": "shards",
    "train": "train",
    "TrainConfig": "train",
    "evaluate": "evaluate",
}

__all__ = sorted(_HOME)


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'enhance' has no attribute {name!r}")
    return getattr(importlib.import_module(f"enhance.{_HOME[name]}"), name)
