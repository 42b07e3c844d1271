"""A log becomes a scene: readers, seeding, fit, densification, and the assets cut from it. Imports scenes and render only."""

import importlib

import scenes.idle  # noqa: F401

_HOME = {
    "FitConfig": "fit",
    "Log": "log",
    "extract_assets": "assets.extract",
    "open_log": "readers",
    "reconstruct": "build",
    "stopped_early": "early",
}

__all__ = sorted(_HOME)


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'recon' has no attribute {name!r}")
    return getattr(importlib.import_module(f"recon.{_HOME[name]}"), name)
