"""A fit of the made-up street that takes seconds."""

from recon.fit.config import FitConfig

CONFIG = FitConfig(steps=160, budget=14_000, stages=((0.0, 2), (0.5, 1)), grow_every=6)
SIZE = (96, 54)
