"""What planes before a plate cost its pixels, by kernels: compared with other plates, smoothed, and the best taken."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from recon.kernels.planes import CHUNKS, PLANES, Prices, choose, compare_kernel, look
from recon.kernels.scanlines import Lines, add_paths
from recon.seeds.stereo import FLAT, UNSEEN, Plate, moments_of
from render.kernels.types import TILE, lanes
from render.launch import run, run_pixels, stage, upload, view

NUDGE, JUMP = 0.06, 0.5
"""What it costs a pixel to be one plane off its neighbour, or any number; a correlation of 1 costs 0, of none 1."""

EDGE = 12.0
"""Levels between neighbours at which a jump costs half."""

PINNED = 1.0
"""What it costs the pixel of a known point to be elsewhere."""

OUTSIDE = 2.0
"""What it costs to be beyond the planes that matter."""

STRETCH = {"cpu": 1024, "cuda": 8}
"""Pixels in a row whose squares an item sums up, at most: on the CPU a whole row, since the squares of two stretches share pixels."""


class Volume:
    """Costs of `PLANES` planes, in equal steps of inverse depth from 0 (the sky) on, for each pixel of a plate that `others`, of its size
    and on its device, are compared with. Memory is taken once for all directions of planes."""

    def __init__(self, plate: Plate, others: list[Plate]) -> None:
        self.plate, device = plate, plate.grey.device
        h, w = plate.grey.shape
        self.others = F.pad(torch.stack([other.grey for other in others]), (1, 2, 1, 2))
        pixels, back = plate.pixels_from_cam(), np.linalg.inv(plate.cam_from_world)
        motion = np.zeros((len(others), 3, 4))
        for of, other in zip(motion, others, strict=True):
            there = other.cam_from_world @ back
            of[:, :3] = other.pixels_from_cam() @ there[:3, :3] @ np.linalg.inv(pixels)
            of[:, 3] = other.pixels_from_cam() @ there[:3, 3]
        self.motion = upload(torch.from_numpy(motion).float(), device)
        self.cost, self.total = torch.empty(h, w, PLANES, device=device), torch.zeros(h, w, PLANES, device=device)
        self.shown = torch.empty(len(others), h, w, TILE, device=device)
        self.path = torch.empty(max(h, w), CHUNKS, TILE, device=device)

    def best(
        self, step: torch.Tensor, bounds: torch.Tensor, known: torch.Tensor, lowest: torch.Tensor, window: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What the best plane costs each pixel, infinite where none matters, and the inverse depth there, NaN where it is not beyond plane
        `lowest` or no other plate shows it, `[h, w]` each.

        All maps are on the host. step: inverse depth `[h, w]` from plane to plane; bounds `[2, h, w]`: the first and the last plane that
        matter, NaN where none does; known `[h, w]`: inverse depths, NaN where not known; window: side of the squares that are compared.
        """
        device = self.plate.grey.device
        with stage(device):
            step, bounds, known, lowest = (upload(t, device) for t in (step, bounds, known, lowest))
            self._compare(step, bounds, known, window)
            self._smooth()
            least, inverse_depth = self._choose(step, bounds, lowest).cpu()
        return least, inverse_depth

    def _compare(self, step: torch.Tensor, bounds: torch.Tensor, known: torch.Tensor, window: int) -> None:
        grey = self.plate.grey
        h, w = grey.shape
        own = torch.cat([grey[None], *moments_of(grey[None], window)])
        # to a square matters what does to any pixel of it
        wide = torch.stack([-bounds[0], bounds[1]]).nan_to_num(-torch.inf)
        for side in ((1, window), (window, 1)):
            wide = F.max_pool2d(wide, side, 1, (side[0] // 2, side[1] // 2))
        near = torch.stack([-wide[0], wide[1]])
        prices = Prices()
        prices.unseen, prices.outside, prices.pinned = UNSEEN, OUTSIDE, PINNED
        told = [view(self.motion, float), view(step, float)]
        shown, spans = view(self.shown, lanes), [view(bounds, float), view(near, float)]
        cost = view(self.cost.view(h, w, CHUNKS, TILE), lanes)
        stretch = min(w, STRETCH[grey.device.type])
        items = h * -(-w // stretch)
        sums = view(torch.empty(items, stretch + 2 * (window // 2), 4, TILE, device=grey.device), lanes)
        for chunk in range(CHUNKS):  # what a chunk needs stays in the cache
            run(look, len(self.shown) * items, [view(self.others, float), *told, spans[1], chunk, shown, stretch], grey.device)
            args = [view(own, float), shown, *told, *spans, view(known, float), chunk, FLAT, prices, sums, cost, stretch]
            run(compare_kernel(window // 2), items, args, grey.device)

    def _smooth(self) -> None:
        """Sum costs along paths from the left, right, top and bottom."""
        h, w = self.plate.grey.shape
        cost, path, total = (view(t.view(-1, CHUNKS, TILE), lanes) for t in (self.cost, self.path, self.total))
        for begun, (many, *where) in enumerate(((h, w, 1, w), (w, 1, w, h))):
            lines = Lines()
            lines.beside, lines.step, lines.count = where
            lines.nudge, lines.jump, lines.edge = NUDGE, JUMP, EDGE
            run(add_paths, many, [lines, cost, view(self.plate.grey.view(-1), float), begun, path, total], self.path.device)

    def _choose(self, step: torch.Tensor, bounds: torch.Tensor, lowest: torch.Tensor) -> torch.Tensor:
        """What `best` gives, `[2, h, w]`."""
        found = torch.empty(2, *step.shape, device=step.device)
        least, inverse_depth = found
        costs = [view(self.cost, float), view(self.total.view(*step.shape, CHUNKS, TILE), lanes)]
        told = [view(t, float) for t in (step, bounds, lowest)]
        run_pixels(choose, step.numel(), [*costs, *told, UNSEEN, view(least, float), view(inverse_depth, float)], step.device)
        return found
