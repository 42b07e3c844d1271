"""Scenes, assets, splats and edits as USD: the only modules that import pxr, but for what `sidestep doctor` asks of it."""
