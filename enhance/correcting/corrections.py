"""What is done to told objects, frame by frame: their colours and missing shadows, as `ObjectNet` finds them, and what they have of noise
and sharpening beyond what is around them; held steady over a clip.

A camera's noise comes first, then its colours' gains, sharpening, and the curves that make a picture of light. So the colours are put right
first, curves and gains in one, then sharpening is undone in linear light, and then there is the noise as the sensor had it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from enhance.correcting.grain import Grain, of_object, sharpening, unsharpened
from enhance.correcting.noise import denoised, variances
from enhance.correcting.objects import ObjectNet, changed, evidence, spots, whole_of
from enhance.correcting.outlines import Box, Boxes, Outline, Outlines, Pixels, along, boxes, reaching_over
from enhance.correcting.seam import fitted
from enhance.correcting.shade import NONE, SEEN, optical_depths, read_ground, shaded

STEADY = 8
"""Frames over which an object's correction is averaged, at most; one that has been seen in as many is looked at again as rarely."""

SLIGHT = 4 / 255
"""Root mean square of a change up to which an object keeps its colours: being right is likelier than being so little wrong. Of
one half as large again four fifths are made (`_surely`)."""
FILLS = 0.8
"""Share of the frame from which an object keeps its colours: what little is around one that large tells nothing for sure on new places."""
USUAL_NOISE, LEAST_NOISE = 2.0, 2e-5
"""Noise variance that a right object may have: to that of what is around it, and beside, about a level of 255 in middle grey."""
BESIDE = 8
"""Pixels beside an object's box that are looked at to take noise and sharpening from it."""
DEEP = 0.25
"""Optical depth up to which an object that lacks no more anywhere has its shadow; of one half as deep again four fifths are drawn."""


@dataclass(frozen=True)
class Correction:
    """Of one object, the mean over the last frames, each None where too little tells; and in how many frames it was seen.

    All on the CPU, where it is decided what is done.

    colours  coefficients `[15]` (`changed`)
    depths   optical depths of its missing shadow
    grain    its own, and what that should be
    noise    `[2]`: the noise variance of it and of what is around it, once its colours are right (`variances`)
    """

    colours: torch.Tensor
    depths: torch.Tensor
    grain: tuple[Grain, Grain] | None
    noise: torch.Tensor | None
    count: int

    def followed(self, new: Correction | None) -> Correction:
        """After one more frame, in which it was looked at anew, or not; its noise is looked at afterwards (`with_noise`)."""
        if new is None:
            return replace(self, count=self.count + 1)
        share = 1 / min(self.count + 1, STEADY)
        colours, depths = torch.lerp(self.colours, new.colours, share), torch.lerp(self.depths, new.depths, share)
        grain = self.grain or new.grain
        if self.grain is not None and new.grain is not None:
            grain = self.grain[0].toward(new.grain[0], share), self.grain[1].toward(new.grain[1], share)
        return Correction(colours, depths, grain, self.noise, self.count + 1)

    def with_noise(self, found: tuple[float, ...] | None) -> Correction:
        """After its noise was looked at in the frame that it followed last."""
        if found is None:
            return self
        noise = torch.tensor(found, dtype=torch.float64)
        return replace(self, noise=noise if self.noise is None else torch.lerp(self.noise, noise, 1 / min(self.count, STEADY)))

    def excess(self) -> tuple[float, float]:
        """How much it was sharpened (`sharpening`), and the noise variance that it has beyond what is usual once that is undone."""
        sharpened = 0.0 if self.grain is None else sharpening(*self.grain)
        own, around = (0.0, 0.0) if self.noise is None else self.noise.tolist()
        return sharpened, max(0.0, own - USUAL_NOISE * around - LEAST_NOISE) / (1 + sharpened) ** 2


Corrections = Mapping[int, Correction]
"""By object."""


@torch.no_grad()
def correct(net: ObjectNet, rgb: torch.Tensor, instance: torch.Tensor, before: Corrections) -> tuple[torch.Tensor, Corrections]:
    """A frame `[3, H, W]` with the objects of `instance` `[H, W]` (ids from 1) in colours that belong there, without noise and sharpening
    that nothing around them has, and with the shadows that they lacked; and their corrections, to be passed with the next frame. Pixels
    that are neither an object's nor shaded stay as they are."""
    ids = instance.cpu()
    found = {i: box for i, box in boxes(ids).items() if not _fills(ids, i, box)}
    if not found:
        return rgb, {}
    counts = {i: before[i].count if i in before else 0 for i in found}
    due = {i: found[i] for i, count in counts.items() if count < STEADY or (count + i) % STEADY == 0}  # not all in the same frame
    over = reaching_over(instance) if due else instance
    new = _looked_at(net, rgb, instance, over, due)
    after = {i: before[i].followed(new.get(i)) if i in before else new[i] for i in found}
    out = rgb.clone(memory_format=torch.contiguous_format)
    _shade(out, instance, found, after)
    _recolour(out, Pixels.of(ids, found, out.device), [after[i].colours for i in found])
    after |= _with_noise(out, over, due, after)
    _calm(out, instance, found, after)
    return out, after


def _fills(instance: torch.Tensor, i: int, box: Box) -> bool:
    """Whether an object leaves so little around it that nothing tells its colours."""
    part = instance[box.rows, box.columns]
    return part.numel() > FILLS * instance.numel() and int((part == i).sum()) > FILLS * instance.numel()


def _looked_at(net: ObjectNet, rgb: torch.Tensor, instance: torch.Tensor, over: torch.Tensor, due: dict[int, Box]) -> Corrections:
    """Corrections by this frame alone of the objects that are due, without noise; `over` is `reaching_over` of the ids."""
    if not due:
        return {}
    outlines, grounds, grains = [], [], []
    for i, box in due.items():
        part, beyond = (x[..., box.outer_rows, box.outer_columns] for x in (rgb, over))
        outlines += [Outline.of(ids, i, box) for ids in (instance, over)]
        grounds.append(box.ground(instance))
        grains.append(of_object(part.permute(1, 2, 0), beyond == i, beyond <= 0))
    objects = Outlines(outlines)
    at = spots(objects, instance.numel())
    guesses = net(evidence(_colours(rgb, at.yx), at, whole_of(rgb)))
    fits = fitted(rgb, objects, guesses, net.usual)
    around = Boxes(due.values(), rgb.device)
    yx, known = around.spread(grounds, SEEN, repeated=False)
    shades = net.shade(read_ground(_colours(rgb, yx), around.places(yx), known)).cpu()
    new = {}
    for i, at_edge, further, shade, grain in zip(due, fits[::2], fits[1::2], shades, grains, strict=True):
        colours, ends = at_edge.with_beyond(further)
        new[i] = Correction(colours, ends * shade, grain, None, 1)
    return new


def _colours(rgb: torch.Tensor, yx: torch.Tensor) -> torch.Tensor:
    """Of a picture `[3, H, W]` at rows and columns `[S, N, 2]`: `[S, N, 3]`."""
    y, x = yx.unbind(2)
    return rgb[:, y, x].movedim(0, -1)


def _with_noise(out: torch.Tensor, over: torch.Tensor, due: dict[int, Box], after: Corrections) -> Corrections:
    """Corrections of the objects that are due after their noise was looked at in `out` `[3, H, W]`, where their colours are right."""
    new = {}
    for i, box in due.items():
        part, ids = (x[..., box.outer_rows, box.outer_columns] for x in (out, over))
        new[i] = after[i].with_noise(variances(part, (ids == i, ids <= 0)))
    return new


def _calm(out: torch.Tensor, instance: torch.Tensor, found: dict[int, Box], after: Corrections) -> None:
    """Take from all objects, in the picture `out` `[3, H, W]`, what they have of noise and sharpening beyond what is around them."""
    for i, box in found.items():
        sharpened, variance = after[i].excess()
        if sharpened == 0 and variance == 0:
            continue
        rows, columns = (slice(max(0, side.start - BESIDE), side.stop + BESIDE) for side in (box.rows, box.columns))
        part, mask = out[:, rows, columns], instance[rows, columns] == i
        light = rgb_to_linear_rgb(part)
        if sharpened > 0:
            light = unsharpened(light.permute(1, 2, 0), light.new_full((3,), sharpened)).permute(2, 0, 1)
        if variance > 0:
            light = denoised(light, variance)
        part.copy_(torch.where(mask, linear_rgb_to_rgb(light.clamp(0, 1)), part))


def _shade(out: torch.Tensor, instance: torch.Tensor, found: dict[int, Box], after: Corrections) -> None:
    """Darken, in the picture `out` `[3, H, W]`, the ground around the objects that lack a shadow."""
    total = torch.zeros_like(out[0])
    for i, box in found.items():
        depths = after[i].depths
        surely = _surely(float(depths.max()), DEEP)
        if surely == 0:
            continue
        lines = along(box.outer_rows, box.rows, out.device), along(box.outer_columns, box.columns, out.device)
        total[box.outer_rows, box.outer_columns] += surely * (optical_depths(*lines, depths.to(out.device)) - NONE).clamp_min(0)
    y, x = ((total > 0) & (instance <= 0)).nonzero().unbind(1)
    out[:, y, x] = shaded(out[:, y, x].T, total[y, x]).T


def _recolour(out: torch.Tensor, pixels: Pixels, colours: Sequence[torch.Tensor]) -> None:
    """Change the colours of objects in the picture `out` `[3, H, W]` by their coefficients, where that is not slight."""
    given = out.flatten(1)[:, pixels.at].T
    coefficients = torch.stack(list(colours)).to(out.device)
    change = changed(given[:, None], pixels.height[:, None], coefficients[pixels.which])[:, 0]
    by = torch.stack([of.mean() for of in change.square().mean(1).split(pixels.counts)]).sqrt()
    surely = [_surely(power, SLIGHT) for power in by.tolist()]
    if any(surely):
        share = torch.tensor(surely, device=out.device)[pixels.which, None]
        out.flatten(1)[:, pixels.at] = torch.where(share > 0, (given + share * change).clamp(0, 1), given).T


def _surely(found: float, slight: float) -> float:
    """How much of a correction is made: none up to a slight one, and the more the larger it is, so that none comes or goes at once in a
    clip whose averages wander about what is slight. By the square, objects of photos would lose 0.4 to 0.9 dB, and by the fourth power
    they lose 0.1 to 0.2; over eight clips their mean colours jump from frame to frame by 0.36 levels at most by the one, by 0.47 by the
    other, and by 1.4 where all is done or nothing."""
    return max(0.0, 1 - (slight / max(found, 1e-9)) ** 4)
