"""Colours of an object that was put in: what its seam, its own pixels and its surroundings say, and a small network that listens.

Where the mask is told, altered colours are a problem of few numbers: one tone curve and saturation for the whole object. What tells
them is fine detail of which a thinned picture shows nothing: along the seam, surfaces go on beyond the mask and only their colours
jump. So the network reads a few hundred pixels of full sharpness: profiles across the seam, pixels inside, around and anywhere.
Trained to be near in the picture, it corrects less the less sure it is. A missing shadow is found apart (`enhance.correcting.shade`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy import ndimage
from torch import nn
from torch.nn import functional as F

from enhance.batch import Batch
from enhance.correcting.shade import DOWN, SEEN, ShadeNet, at_most

PIXELS = 384
"""Pixels of an object by which a correction is judged."""

SEAM, INSIDE, AROUND, ROWS, COLUMNS = 192, 96, 96, 8, 12
"""How many profiles and pixels are read; of the whole picture, a grid of ROWS x COLUMNS."""
REACH = 4
"""Pixels of a profile on either side of the seam."""
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0))
FEWEST = 64
"""Pixels that an object must have: what is smaller stays as it is."""
COEFFICIENTS = 15
LUMA = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class Evidence(Batch):
    """What is read of B objects: colours are -1..1, places -1..1 in the object's box.

    seam    `[B, SEAM, 8, 4]`: colours from REACH pixels inside to REACH outside, and whether each is in the object
    place   `[B, SEAM, 4]`: where the profile is, and its direction
    known   bool `[B, SEAM]`: which profiles there are
    inside  `[B, INSIDE, 6]`, around `[B, AROUND, 6]`: colour, place, and the logarithm of the object's share of the frame
    whole   `[B, ROWS * COLUMNS, 5]`: colour, and place in the frame
    """

    seam: torch.Tensor
    place: torch.Tensor
    known: torch.Tensor
    inside: torch.Tensor
    around: torch.Tensor
    whole: torch.Tensor

    @classmethod
    def stacked(cls, parts: list[Evidence]) -> Evidence:
        return cls(**{f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)})


@dataclass(frozen=True)
class Objects(Batch):
    """Evidence of B objects, and pixels `[B, PIXELS, 3]` as given and as they should be, at `height` `[B, PIXELS]` in the box."""

    evidence: Evidence
    given: torch.Tensor
    target: torch.Tensor
    height: torch.Tensor


@dataclass(frozen=True)
class Box:
    """An object's own rows and columns of a frame, and those with what is around it."""

    rows: slice
    columns: slice
    outer_rows: slice
    outer_columns: slice

    @classmethod
    def around(cls, rows: slice, columns: slice, height: int, width: int) -> Box:
        wide = max(8, (rows.stop - rows.start) // 2), max(8, (columns.stop - columns.start) // 2)
        grown = [slice(max(0, s.start - by), min(n, s.stop + by)) for s, by, n in zip((rows, columns), wide, (height, width), strict=True)]
        return cls(rows, columns, *grown)

    def places(self, where: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Of the N pixels that are True in bool `[h, w]` of the outer part: places `[N, 2]` down and across the box, -1..1 within it; and
        their rows and columns in the frame."""
        return self._at(*where.nonzero().unbind(1))

    def ground(self, free: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """The same of those that `read_ground` would read, at most SEEN."""
        above = int((along(self.outer_rows, self.rows, free.device) <= DOWN[0]).sum())
        found = free[above:].nonzero()
        y, x = found[at_most(SEEN, len(found), free.device)].unbind(1)
        return self._at(y + above, x)

    def _at(self, y: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        y, x = y + self.outer_rows.start, x + self.outer_columns.start
        return self.placed(y, x), (y, x)

    def placed(self, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Places `[N, 2]` in the box of rows and columns of the frame."""
        return torch.stack([_share(y, self.rows), _share(x, self.columns)], -1)


def along(part: slice, side: slice, device: torch.device) -> torch.Tensor:
    """Places `[n]` of the pixels of `part` along a side of a box: -1 where that begins, 1 where it ends."""
    return _share(torch.arange(part.start, part.stop, device=device), side)


def _share(at: torch.Tensor, side: slice) -> torch.Tensor:
    return (at + 0.5 - side.start) / (side.stop - side.start) * 2 - 1


def boxes(instance: torch.Tensor) -> dict[int, Box]:
    """Of every object of FEWEST pixels and more in `[H, W]`, by its id above 0."""
    ids = instance.clamp_min(0).long().cpu().numpy()
    height, width = ids.shape
    names: Sequence[int] = range(int(ids.max()) + 1)
    if len(names) > ids.size:  # as colours that stand for objects: SciPy would make a list as long as the highest
        several, ids = np.unique(np.append(ids, 0), return_inverse=True)
        names, ids = several.tolist(), ids[:-1].reshape(height, width)
    found = {}
    for i, box in enumerate(ndimage.find_objects(ids), 1):
        if box is not None and int((ids[box] == i).sum()) >= FEWEST:
            found[names[i]] = Box.around(box[0], box[1], height, width)
    return found


def reaching_over(ids: torch.Tensor) -> torch.Tensor:
    """Ids `[h, w]` where every object has also the pixels next to it that are nobody's (0 and less).

    So objects are looked at. At the last pixel that is mostly an object's, and the next, colours are still a mixture of both: what differs
    across the seam there is the object from its ground, which would be taken for a wrong light. A pixel on, it is the ground on both sides.
    """
    near = F.pad(ids.clamp_min(0), (1, 1, 1, 1))
    near = torch.maximum(torch.maximum(near[:-2], near[1:-1]), near[2:])
    near = torch.maximum(torch.maximum(near[:, :-2], near[:, 1:-1]), near[:, 2:])
    return torch.where((ids <= 0) & (near > 0), near, ids)


def grid_of(rgb: torch.Tensor) -> torch.Tensor:
    """Evenly spaced pixels of a frame `[3, H, W]`: `[3, ROWS, COLUMNS]`, of which the grid is all of them again."""
    y, x = _grid(rgb.device)
    return rgb[:, (y * rgb.shape[1]).long()[:, None], (x * rgb.shape[2]).long()]


def whole_of(rgb: torch.Tensor) -> torch.Tensor:
    """`grid_of` a frame `[3, H, W]` as Evidence has it, `[1, ROWS * COLUMNS, 5]`."""
    places = torch.stack(torch.meshgrid(*_grid(rgb.device), indexing="ij")) * 2 - 1
    return torch.cat([grid_of(rgb) * 2 - 1, places]).flatten(1).T[None]


def _grid(device: torch.device) -> tuple[torch.Tensor, ...]:
    """Rows and columns of the grid, from 0 to 1."""
    return tuple((torch.arange(n, device=device) + 0.5) / n for n in (ROWS, COLUMNS))


@dataclass(frozen=True)
class Spots:
    """Where an object is looked at.

    yx      `[N, 2]`: rows and columns of the box's outer part: of the seam's profiles, of pixels inside, and around
    place   `[M, 2]`: profiles' and pixels' places in the box, -1..1
    along   `[SEAM, 2]`: the direction of each profile, outwards
    within  `[SEAM, 8]`: which of a profile's pixels are in the object
    known   bool `[SEAM]`: which profiles there are
    size    logarithm of the object's share of the frame, near 0
    edges   `[E, 4]`: all pixels at the seam, and the way out along rows or columns
    """

    yx: torch.Tensor
    place: torch.Tensor
    along: torch.Tensor
    within: torch.Tensor
    known: torch.Tensor
    size: float
    edges: torch.Tensor


def spots(mask: torch.Tensor, box: Box, share: float) -> Spots:
    """Of an object with bool `mask` `[h, w]` in the box's outer part and with its share of the frame."""
    seam = _edges(mask)
    count = min(SEAM, len(seam))
    known = torch.arange(SEAM, device=mask.device) < count
    edges = F.pad(_spread(seam, count) if count else seam, (0, 0, 0, SEAM - count))
    steps = torch.arange(1 - REACH, REACH + 1, device=mask.device)
    y = (edges[:, :1] + steps * edges[:, 2:3]).clamp(0, mask.shape[0] - 1)
    x = (edges[:, 1:2] + steps * edges[:, 3:]).clamp(0, mask.shape[1] - 1)
    pixels = [_spread(mask.nonzero(), INSIDE), _spread((mask if mask.all() else ~mask).nonzero(), AROUND)]
    yx = torch.cat([edges[:, :2], *pixels])
    return Spots(
        torch.cat([torch.stack([y, x], -1).flatten(0, 1), *pixels]),
        box.placed(yx[:, 0] + box.outer_rows.start, yx[:, 1] + box.outer_columns.start),
        edges[:, 2:].float(),
        mask[y, x],
        known,
        math.log(share) / 4 + 1,
        seam,
    )


def evidence(colours: torch.Tensor, at: Spots, whole: torch.Tensor) -> Evidence:
    """Of one object: `colours` `[N, 3]` of its spots, and `whole_of` the frame."""
    profiles, pixels = (colours * 2 - 1).split([2 * REACH * SEAM, INSIDE + AROUND])
    places, around = at.place.split([SEAM, INSIDE + AROUND])
    pixels = torch.cat([pixels, around, torch.full_like(around[:, :1], at.size)], 1)
    inside, outside = pixels.split([INSIDE, AROUND])
    seam = torch.cat([profiles.view(SEAM, 2 * REACH, 3), at.within[..., None].to(colours.dtype)], 2)
    return Evidence(seam[None], torch.cat([places, at.along], 1)[None], at.known[None], inside[None], outside[None], whole)


def _edges(mask: torch.Tensor) -> torch.Tensor:
    """Pixels of `mask` at its seam `[E, 4]`, with the way out along rows or columns; where the picture ends is no seam."""
    h, w = mask.shape
    further = F.pad(mask, (1, 1, 1, 1), value=True)
    found = []
    for dy, dx in DIRECTIONS:
        yx = (mask & ~further[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w]).nonzero()
        found.append(torch.cat([yx, torch.tensor([[dy, dx]], device=yx.device).expand(len(yx), 2)], 1))
    return torch.cat(found)


def _spread(rows: torch.Tensor, count: int) -> torch.Tensor:
    """`count` of the rows, evenly spaced."""
    at = (torch.arange(count, device=rows.device) + 0.5) / count * len(rows)
    return rows[at.long()]


def _reader(channels: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(channels, width), nn.SiLU(), nn.Linear(width, width), nn.LayerNorm(width))


class _Round(nn.Module):
    """Questions attend to what was read, then to each other."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.asked, self.mixed, self.thought = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)
        self.read = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mix = nn.MultiheadAttention(width, heads, batch_first=True)
        self.think = nn.Sequential(nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width))

    def forward(self, x: torch.Tensor, tokens: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
        x = x + _attended(self.read, self.asked(x), tokens, known)
        q = self.mixed(x)
        x = x + _attended(self.mix, q, q)
        return x + self.think(self.thought(x))


def _attended(layer: nn.MultiheadAttention, x: torch.Tensor, tokens: torch.Tensor, known: torch.Tensor | None = None) -> torch.Tensor:
    """The layer's own result for queries `[B, Q, C]` and tokens `[B, N, C]`, of which bool `[B, N]` are `known`; it would lay them out anew
    before its products, which costs more than those."""
    width, heads = layer.embed_dim, layer.num_heads
    weight, bias = layer.in_proj_weight, layer.in_proj_bias
    q = F.linear(x, weight[:width], bias[:width]).unflatten(-1, (heads, -1)).transpose(1, 2)
    k, v = F.linear(tokens, weight[width:], bias[width:]).unflatten(-1, (2, heads, -1)).permute(2, 0, 3, 1, 4)
    mask = None if known is None else known[:, None, None]
    return layer.out_proj(F.scaled_dot_product_attention(q, k, v, mask).transpose(1, 2).flatten(2))


class ObjectNet(nn.Module):
    """Evidence to coefficients `[B, 15]` of a colour change for the whole object (`changed`), zero at first; `shade` goes with it, and
    `usual`, the root of the covariance of such changes, by which a seam is read (`enhance.correcting.seam`)."""

    usual: torch.Tensor

    def __init__(self, width: int = 96, heads: int = 4, questions: int = 12, rounds: int = 3):
        super().__init__()
        self.seam = _reader(2 * REACH * 4 + 4, width)
        self.inside = _reader(6, width)
        self.around = _reader(6, width)
        self.whole = _reader(5, width)
        self.questions = nn.Parameter(torch.randn(questions, width))
        self.rounds = nn.ModuleList(_Round(width, heads) for _ in range(rounds))
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Flatten(), nn.Linear(questions * width, width), nn.SiLU())
        self.last = nn.Linear(width, COEFFICIENTS)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.shade = ShadeNet()
        self.register_buffer("usual", torch.zeros(COEFFICIENTS, COEFFICIENTS))

    def forward(self, e: Evidence) -> torch.Tensor:
        seam = self.seam(torch.cat([e.seam.flatten(2), e.place], 2))
        tokens = torch.cat([seam, self.inside(e.inside), self.around(e.around), self.whole(e.whole)], 1)
        known = F.pad(e.known, (0, tokens.shape[1] - e.known.shape[1]), value=True)
        x = self.questions.expand(len(tokens), -1, -1)
        for each in self.rounds:
            x = each(x, tokens, known)
        return self.last(self.head(x)).float()


def changed(rgb: torch.Tensor, height: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """What `coefficients` `[B, 15]` add to `rgb` `[B, N, 3]` at heights `[B, N]`, -1 at the object's top and 1 at its
    base: per channel a + b x + c x^2 + d (luma - x) + e height x."""
    a, b, c, d, e = (coefficients[:, None, i : i + 3] for i in range(0, COEFFICIENTS, 3))
    luma = (rgb @ rgb.new_tensor(LUMA))[..., None]
    return a + rgb * (b + c * rgb + e * height[..., None]) + d * (luma - rgb)
