"""What the sky stands in for while a fit runs: errors blame splats, and where there are none, none would grow."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from scipy import ndimage

from recon.seeds.fill import STEP, Search
from recon.views.frames import Frames
from recon.views.skies import like_sky
from recon.views.view import View
from scenes.gaussians import Gaussians

REFILLED_AT = (0.2, 0.4)
"""Parts of the fit at which it is looked for."""

WRONG = 0.08
"""By how much colours are wrong, at least, where something is missing."""


def missed(search: Search, frames: Frames, drawn: Callable[[View], dict[str, torch.Tensor]], sh_count: int) -> Iterator[Gaussians]:
    """By searched view splats of what it shows and neither splats nor sky do, if anything; drawn: a view's "rgb", "alpha" and "depth" by
    what there is by then, those that came before included."""
    for view, camera, hidden in search:
        shown = drawn(view)
        rgb, alpha, depth = (shown[name].cpu().numpy() for name in ("rgb", "alpha", "depth"))
        image = view.image.numpy()
        right = ndimage.uniform_filter(np.abs(rgb - image / np.float32(255)).mean(-1), STEP) < WRONG
        more = search.found(view, camera, hidden, alpha, depth, right | like_sky(image, frames.sky_of(view)), sh_count)
        if len(more):
            yield more
