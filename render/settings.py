"""What stays the same during one call of the rasterizer, and the kernels' limits that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch

from render.budget import cutoff
from render.frame_types import RenderConfig
from render.kernels.types import TILE, Wanted
from render.launch import stream_of
from render.room import Room
from scenes.gaussians import SplatModel
from scenes.lenses import Lens, Orthographic, Pinhole


@dataclass(frozen=True)
class Settings:
    """Image size, model, config, what is wanted, each instance's id, lens type, and what the shutter does.

    crop: x, y, width, height of the part of the image that is drawn, in pixels; all of it where None. mask bool `[H, W]` of the whole
    image: which pixels are drawn. gradients: whether any may be asked for, of anything. looks: of each instance, which of the rays look
    at it. room: for tile lists whose length is not asked for. splats: how many there are, seen or not, among which a budget
    of error is divided.
    """

    width: int
    height: int
    model: SplatModel
    config: RenderConfig
    wanted: Wanted
    instances: tuple[int, ...]
    lens: type[Lens] = Pinhole
    shutter: str = "global"
    rolling: bool = False
    crop: tuple[int, int, int, int] | None = None
    mask: torch.Tensor | None = None
    gradients: bool = True
    looks: tuple[int, ...] = ()
    room: Room | None = None
    splats: int = 0

    @property
    def part(self) -> tuple[int, int, int, int]:
        """x, y, width, height of what is drawn."""
        return self.crop or (0, 0, self.width, self.height)

    @property
    def tile_left(self) -> int:
        return self.part[0] // TILE

    @property
    def tile_top(self) -> int:
        return self.part[1] // TILE

    @property
    def tiles_x(self) -> int:
        """Tiles that are drawn, from `tile_left` on: the grid is anchored at the image's origin, whatever the crop."""
        return -(-(self.part[0] + self.part[2]) // TILE) - self.tile_left

    @property
    def tiles_y(self) -> int:
        return -(-(self.part[1] + self.part[3]) // TILE) - self.tile_top

    @property
    def of_image(self) -> tuple[slice, slice]:
        """Rows and columns of what is drawn."""
        x, y, width, height = self.part
        return slice(y, y + height), slice(x, x + width)

    def drawn_tiles(self, device: torch.device) -> torch.Tensor:
        """int32 `[rows, columns]` of all the image's tiles: 0 for those without a pixel of the mask."""
        if self.mask is None:
            return _all_tiles(-(-self.height // TILE), -(-self.width // TILE), device, stream_of(device))
        pixels = self.mask[None, None].to(device, torch.float32)
        return torch.nn.functional.max_pool2d(pixels, TILE, ceil_mode=True)[0, 0].to(torch.int32)

    @property
    def cutoff(self) -> float:
        budget = self.config.max_error
        return max(self.config.alpha_cutoff if budget is None else cutoff(budget, self.splats), 1e-10)

    @property
    def by_rays(self) -> bool:
        """Whether pixels look along their own rays."""
        return self.model.response == "ray" or self.config.order == "pixel"

    @property
    def eyes(self) -> bool:
        """Whether the pixels' rays begin in places of their own."""
        return self.rolling or self.lens is Orthographic

    @property
    def squarings(self) -> int:
        """How often exp's polynomial is squared, so that its argument stays within 1.5."""
        return max(2, math.ceil(math.log2(-math.log(self.cutoff) / 1.5)))

    @property
    def alpha_max(self) -> float:
        return min(self.config.alpha_max, 1 - 1e-6)

    @property
    def termination(self) -> float:
        """Transmittance below which a pixel is done. Not 0: backward divides by what is left, so nothing may underflow."""
        return max(self.config.termination, 1e-10)


@lru_cache(maxsize=16)
def _all_tiles(rows: int, columns: int, device: torch.device, _stream: int) -> torch.Tensor:
    """Kept: nobody writes to it."""
    return torch.ones(rows, columns, dtype=torch.int32, device=device)
