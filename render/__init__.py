"""How it looks: the Warp rasterizer, frames, clips, image and video files. Rooms are loaded when first used."""

import importlib
import sys
import types
from typing import TYPE_CHECKING

import scenes.idle  # noqa: F401

_HOME = {
    "rasterize": "rasterize",
    "Frame": "frame_types",
    "RenderConfig": "frame_types",
    "render_frame": "frame",
    "render_clip": "clip",
}

__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from render.clip import render_clip as render_clip
    from render.frame import render_frame as render_frame
    from render.frame_types import Frame as Frame
    from render.frame_types import RenderConfig as RenderConfig
    from render.rasterize import rasterize as rasterize


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'render' has no attribute {name!r}")
    return getattr(importlib.import_module(f"render.{_HOME[name]}"), name)


class _Package(types.ModuleType):
    def __setattr__(self, name, value):
        # importing render/rasterize.py would bind the module to the name that belongs to the call
        if not (name in _HOME and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
