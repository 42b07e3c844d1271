"""A frame becomes a better frame: degradations, pairs, the network, its training, enhancement, evaluation.

Images are display-referred sRGB float32 `[H, W, 3]` in 0..1 at this package's border and `[B, 3, H, W]` inside it.
Names are loaded when first used, so that `import enhance` costs nothing.
"""

import importlib
import sys
import types
from typing import TYPE_CHECKING

import scenes.idle  # noqa: F401

_HOME = {
    "Enhancer": "enhancer",
    "Memory": "enhancer",
    "enhance_video": "clip",
    "Grade": "correcting.grade",
    "Graded": "correcting.grade",
    "Isp": "pairs.isp",
    "random_isp": "pairs.isp",
    "make_pairs": "pairs.make",
    "PairSet": "pairs.shards",
    "train": "training.train",
    "TrainConfig": "training.run",
    "evaluate": "evaluate",
}

__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from enhance.clip import enhance_video as enhance_video
    from enhance.correcting.grade import Grade as Grade
    from enhance.correcting.grade import Graded as Graded
    from enhance.enhancer import Enhancer as Enhancer
    from enhance.enhancer import Memory as Memory
    from enhance.evaluate import evaluate as evaluate
    from enhance.pairs.isp import Isp as Isp
    from enhance.pairs.isp import random_isp as random_isp
    from enhance.pairs.make import make_pairs as make_pairs
    from enhance.pairs.shards import PairSet as PairSet
    from enhance.training.run import TrainConfig as TrainConfig
    from enhance.training.train import train as train


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'enhance' has no attribute {name!r}")
    return getattr(importlib.import_module(f"enhance.{_HOME[name]}"), name)


class _Package(types.ModuleType):
    def __setattr__(self, name, value):
        # importing enhance/evaluate.py would bind the module to the name that belongs to the call
        if not (name in _HOME and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
