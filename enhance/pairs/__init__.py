"""Pairs of wrong and right frames: how they are made, and kept on disk."""
