"""What is done to told objects, frame by frame: their colours and missing shadows, as `ObjectNet` finds them, and what they have of noise
and sharpening beyond what is around them; held steady over a clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from enhance.correcting.grain import Excess, Grain, of_object, usual_of, without
from enhance.correcting.objects import Box, Evidence, ObjectNet, along, boxes, changed, evidence, reaching_over, spots, whole_of
from enhance.correcting.seam import fitted
from enhance.correcting.shade import NONE, optical_depths, read_ground, shaded

STEADY = 8
"""Frames over which an object's correction is averaged, at most; one that has been seen in as many is looked at again as rarely."""

SLIGHT = 4 / 255
"""Root mean square of a change up to which an object keeps its colours: being right is likelier than being so little wrong. Of
one half as large again four fifths are made (`_surely`)."""
FILLS = 0.8
"""Share of the frame from which an object keeps its colours: what little is around one that large tells nothing for sure on new places."""
DEEP = 0.25
"""Optical depth up to which an object that lacks no more anywhere has its shadow; of one half as deep again four fifths are drawn."""


@dataclass(frozen=True)
class Correction:
    """Of one object, the mean over the last frames: coefficients `[15]` of its colours, optical depths of its missing shadow, its grain and
    what that should be (None where too little tells); and in how many frames it was seen."""

    colours: torch.Tensor
    depths: torch.Tensor
    grain: tuple[Grain, Grain] | None
    count: int

    def followed(self, new: Correction | None) -> Correction:
        """After one more frame, in which it was looked at anew, or not."""
        if new is None:
            return replace(self, count=self.count + 1)
        share = 1 / min(self.count + 1, STEADY)
        colours, depths = torch.lerp(self.colours, new.colours, share), torch.lerp(self.depths, new.depths, share)
        grain = self.grain or new.grain
        if self.grain is not None and new.grain is not None:
            grain = self.grain[0].toward(new.grain[0], share), self.grain[1].toward(new.grain[1], share)
        return Correction(colours, depths, grain, self.count + 1)

    def excess(self) -> Excess | None:
        """What it has of noise and sharpening that is no texture; None where nothing."""
        if self.grain is None:
            return None
        given, wanted = self.grain
        excess = Excess.of(given, wanted).beyond(usual_of(given.power))
        return excess if excess.any() else None


Corrections = Mapping[int, Correction]
"""By object."""


@torch.no_grad()
def correct(net: ObjectNet, rgb: torch.Tensor, instance: torch.Tensor, before: Corrections) -> tuple[torch.Tensor, Corrections]:
    """A frame `[3, H, W]` with the objects of `instance` `[H, W]` (ids from 1) in colours that belong there, without noise and sharpening
    that nothing around them has, and with the shadows that they lacked; and their corrections, to be passed with the next frame. Pixels
    that are neither an object's nor shaded stay as they are."""
    found = {i: box for i, box in boxes(instance).items() if not _fills(instance, i, box)}
    if not found:
        return rgb, {}
    after = _looked_at(net, rgb, instance, found, before)
    out = rgb.clone()
    _calm(out, instance, found, after)
    _shade(out, instance, found, after)
    _recolour(out, instance, found, after)
    return out, after


def _fills(instance: torch.Tensor, i: int, box: Box) -> bool:
    """Whether an object leaves so little around it that nothing tells its colours."""
    part = instance[box.rows, box.columns]
    return part.numel() > FILLS * instance.numel() and int((part == i).sum()) > FILLS * instance.numel()


def _looked_at(net: ObjectNet, rgb: torch.Tensor, instance: torch.Tensor, found: dict[int, Box], before: Corrections) -> Corrections:
    """Objects' corrections after this frame: those that are due are looked at anew."""
    counts = {i: before[i].count if i in before else 0 for i in found}
    due = [i for i, count in counts.items() if count < STEADY or (count + i) % STEADY == 0]  # not all in the same frame
    new: dict[int, Correction] = {}
    if due:
        whole, read, around, seams, grains = whole_of(rgb), [], [], [], []
        over = reaching_over(instance)
        for i in due:
            box = found[i]
            part, edge, beyond = (x[..., box.outer_rows, box.outer_columns] for x in (rgb, instance, over))
            for ids in (edge, beyond):
                mask = ids == i
                at = spots(mask, box, float(mask.sum()) / rgb[0].numel())
                y, x = at.yx.unbind(1)
                read.append(evidence(part[:, y, x].T, at, whole))
                seams.append((part, ids, i, at.edges, box))
            places, (y, x) = box.ground(edge <= 0)
            around.append(read_ground(rgb[:, y, x].T, places))
            grains.append(of_object(part.permute(1, 2, 0), beyond == i, beyond <= 0))
        fits = [fitted(*seam, guess, net.usual) for seam, guess in zip(seams, net(Evidence.stacked(read)), strict=True)]
        shades = net.shade(torch.stack(around))
        for i, at_edge, further, shade, grain in zip(due, fits[::2], fits[1::2], shades, grains, strict=True):
            colours, ends = at_edge.with_beyond(further)
            new[i] = Correction(colours, ends * shade, grain, 1)
    return {i: before[i].followed(new.get(i)) if i in before else new[i] for i in found}


def _calm(out: torch.Tensor, instance: torch.Tensor, found: dict[int, Box], after: Corrections) -> None:
    """Take from all objects, in the picture `out` `[3, H, W]`, what they have of noise and sharpening beyond what is around them."""
    for i, box in found.items():
        excess = after[i].excess()
        if excess is not None:
            part, mask = out[:, box.outer_rows, box.outer_columns], instance[box.outer_rows, box.outer_columns] == i
            part.copy_(torch.where(mask, without(part.permute(1, 2, 0), excess).permute(2, 0, 1), part))


def _shade(out: torch.Tensor, instance: torch.Tensor, found: dict[int, Box], after: Corrections) -> None:
    """Darken, in the picture `out` `[3, H, W]`, the ground around the objects that lack a shadow."""
    total = torch.zeros_like(out[0])
    for i, box in found.items():
        depths = after[i].depths
        surely = _surely(float(depths.max()), DEEP)
        if surely == 0:
            continue
        lines = along(box.outer_rows, box.rows, out.device), along(box.outer_columns, box.columns, out.device)
        total[box.outer_rows, box.outer_columns] += surely * (optical_depths(*lines, depths) - NONE).clamp_min(0)
    y, x = ((total > 0) & (instance <= 0)).nonzero().unbind(1)
    out[:, y, x] = shaded(out[:, y, x].T, total[y, x]).T


def _recolour(out: torch.Tensor, instance: torch.Tensor, found: dict[int, Box], after: Corrections) -> None:
    """Change the colours of all objects in the picture `out` `[3, H, W]`, where that is not slight."""
    for i, box in found.items():
        part, mask = out[:, box.rows, box.columns], instance[box.rows, box.columns] == i
        given, height = part.permute(1, 2, 0), along(box.rows, box.rows, out.device)
        change = changed(given, height[:, None].expand(mask.shape), after[i].colours[None])
        surely = _surely(float(change.square().mean(-1)[mask].mean().sqrt()), SLIGHT)
        if surely > 0:
            part.copy_(torch.where(mask, (given + surely * change).clamp(0, 1).permute(2, 0, 1), part))


def _surely(found: float, slight: float) -> float:
    """How much of a correction is made: none up to a slight one, and the more the larger it is, so that none comes or goes at once in a
    clip whose averages wander about what is slight. By the square, objects of photos would lose 0.4 to 0.9 dB, and by the fourth power
    they lose 0.1 to 0.2; over eight clips their mean colours jump from frame to frame by 0.36 levels at most by the one, by 0.47 by the
    other, and by 1.4 where all is done or nothing."""
    return max(0.0, 1 - (slight / max(found, 1e-9)) ** 4)
