"""Colours of an object that was put in: what its seam, its own pixels and its surroundings say, and a small network that listens.

Where the mask is told, altered colours are a problem of few numbers: one tone curve and saturation for the whole object. What tells
them is fine detail of which a thinned picture shows nothing: along the seam, surfaces go on beyond the mask and only their colours
jump. So the network reads a few hundred pixels of full sharpness: profiles across the seam, pixels inside, around and anywhere.
Trained to be near in the picture, it corrects less the less sure it is. A missing shadow is found apart (`enhance.correcting.shade`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import nn
from torch.nn import functional as F

from enhance.batch import Batch
from enhance.correcting.outlines import Outlines
from enhance.correcting.shade import ShadeNet

PIXELS = 384
"""Pixels of an object by which a correction is judged."""

SEAM, INSIDE, AROUND, ROWS, COLUMNS = 192, 96, 96, 8, 12
"""How many profiles and pixels are read; of the whole picture, a grid of ROWS x COLUMNS."""
REACH = 4
"""Pixels of a profile on either side of the seam."""
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
    """Where S objects are looked at.

    yx      `[S, N, 2]`: rows and columns of the frame: of the seam's profiles, of pixels inside, and around
    place   `[S, M, 2]`: profiles' and pixels' places in the box, -1..1
    along   `[S, SEAM, 2]`: the direction of each profile, outwards
    within  `[S, SEAM, 8]`: which of a profile's pixels are in the object
    known   bool `[S, SEAM]`: which profiles there are
    size    `[S]`: logarithm of the object's share of the frame, near 0
    """

    yx: torch.Tensor
    place: torch.Tensor
    along: torch.Tensor
    within: torch.Tensor
    known: torch.Tensor
    size: torch.Tensor


def spots(objects: Outlines, frame: int) -> Spots:
    """Of objects of a frame of so many pixels."""
    edges, known = objects.seam(SEAM)
    steps = torch.arange(1 - REACH, REACH + 1, device=edges.device)
    first, last = objects.first[:, None, None], objects.end[:, None, None] - 1
    way = (edges[:, :, None, :2] + steps[:, None] * edges[:, :, None, 2:]).clamp(first, last)
    inside = objects.spread([o.own for o in objects.each], INSIDE)[0]
    around = objects.spread([o.beside for o in objects.each], AROUND)[0]
    sizes = torch.tensor([len(o.own) / frame for o in objects.each], device=edges.device)
    return Spots(
        torch.cat([way.flatten(1, 2), inside, around], 1),
        objects.places(torch.cat([edges[..., :2], inside, around], 1)),
        edges[..., 2:].float(),
        objects.mine(objects.ids(*way.unbind(3))),
        known,
        sizes.log() / 4 + 1,
    )


def evidence(colours: torch.Tensor, at: Spots, whole: torch.Tensor) -> Evidence:
    """Of S objects: `colours` `[S, N, 3]` of their spots, and `whole_of` the frame."""
    profiles, pixels = (colours * 2 - 1).split([2 * REACH * SEAM, INSIDE + AROUND], 1)
    places, around = at.place.split([SEAM, INSIDE + AROUND], 1)
    pixels = torch.cat([pixels, around, at.size[:, None, None].expand(-1, INSIDE + AROUND, 1)], 2)
    inside, outside = pixels.split([INSIDE, AROUND], 1)
    seam = torch.cat([profiles.unflatten(1, (SEAM, 2 * REACH)), at.within[..., None].to(colours.dtype)], 3)
    return Evidence(seam, torch.cat([places, at.along], 2), at.known, inside, outside, whole.expand(len(seam), -1, -1))


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
