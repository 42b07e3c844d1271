"""The enhancer as it is used: one call a frame, state passed in and out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch.nn import functional as F

from enhance.alike import alike, thin
from enhance.correcting.corrections import Corrections, correct
from enhance.network.net import MULTIPLE, Net, photos_of
from enhance.network.past import Past
from enhance.network.precision import channels_last, has_bfloat16
from enhance.network.weights_file import BUILTIN, REPAIR_GAIN, WORTH, is_net, load_net
from enhance.step import Steps, checked
from enhance.tiles import Tiles
from render.frame_types import Frame
from scenes.opening import check_device

LONGEST = 4
"""Frames that needed nothing after which the past is given up: each that is followed blurs it."""


@dataclass(frozen=True)
class Memory:
    """The state between the frames of a clip.

    past   the network's state of the last frame that it processed; None where that is too long ago
    size   height and width of the frames in pixels
    flow   whether they had flow
    since  `[1, 2, H, W]` each: flows of the frames since then, which were skipped
    objects  colour corrections so far, by instance id
    look   `[1, 3, h, w]`: the last input frame that had instances, downsampled, to detect cuts; None where none had
    """

    past: Past | None
    size: tuple[int, int]
    flow: bool
    since: tuple[torch.Tensor, ...] = ()
    objects: Corrections = field(default_factory=dict)
    look: torch.Tensor | None = None


class Enhancer:
    """A trained network behind the call that every enhancer has: `better, memory = enhancer.step(frame, memory)`."""

    reads: tuple[str, ...] = ("flow_prev", "instance", "reference")

    def __init__(
        self,
        net: Net,
        about: dict | None = None,
        device: str | torch.device = "cpu",
        bfloat16: bool | None = None,
        history: int | None = None,
        repair: bool | None = None,
    ):
        """bfloat16: whether to compute in it; None: where that is fast. history: past frames that are used; None: as many as the network
        was trained with. repair: whether the network repairs artefacts of rendering; None: where its training measured a gain, without
        and with photos. Without it, instances are still corrected, and references blended in."""
        self.device = torch.device(device)
        self.net = channels_last(net.eval().requires_grad_(False).to(self.device))
        self.about = about or {}
        self.bfloat16 = has_bfloat16(self.device) if bfloat16 is None else bfloat16
        self.history = net.config.history if history is None else history
        if self.history not in range(net.config.history + 1):
            raise ValueError(f"history must be a whole number from 0 to {net.config.history}, as the network was trained, got {history}")
        gains = self.about.get(REPAIR_GAIN, (WORTH, WORTH))
        self.repairs = tuple(gain >= WORTH if repair is None else repair for gain in gains)
        if not any(self.repairs):
            self.reads = ("instance", "reference")

    def for_photos(self) -> Enhancer:
        """The same for photos with inserted objects: these are corrected, and nothing else is repaired."""
        return Enhancer(self.net, self.about, self.device, self.bfloat16, self.history, repair=False)

    @classmethod
    def load(cls, weights: str | Path = "builtin", device: str | torch.device = "cpu", **how) -> Steps:
        """The shipped weights ("builtin"), a file that `sidestep train` wrote, or a public model's checkpoint, which `open_public` names.

        FileNotFoundError where there is none, ValueError where it is not whole or not an enhancer's, or there is no such device.
        """
        check_device(device)
        if weights == "builtin" or is_net(weights):
            net, about = load_net(BUILTIN if weights == "builtin" else weights)
            return cls(net, about, device, **how)
        from enhance.checkpoints import open_public

        return open_public(weights, device, **how)

    @torch.no_grad()  # not inference mode, whose tensors nobody may write to
    def step(self, frame: Frame | torch.Tensor, memory: Memory | None = None) -> tuple[torch.Tensor, Memory]:
        """One frame enhanced: float32 `[H, W, 3]` in 0..1, and the memory to pass with the next frame.

        frame   rgb `[H, W, 3]` display-referred, of any size (beyond 1280 pixels a side it is worked on in parts), or a rendered
                Frame, of which these are used, all optional: flow_prev to warp the memory, instance for inserted objects, need for where
                to repair at all, and reference for what photos show there (`render/references.py`). Without flow the memory stays in
                place.
        memory  of the frame before; None at the start of a clip. It is dropped where the size changed, where a frame lacks
                the flow that the frames before it had, and after a cut or a jump, where the pictures do not look alike.

        With repairs off (`repair`), only instances are corrected and references blended in. Tiles of 32 x 32 that need
        nothing come back exactly as they went in (clamped to 0..1); a frame that needs nothing costs nothing. Raises ValueError for values
        that are not finite.
        """
        given = checked(frame)
        height, width = given.rgb.shape[:2]
        if memory is not None and (memory.size != (height, width) or (memory.flow and given.flow is None)):
            memory = None
        rgb = given.rgb.to(self.device, torch.float32).clamp(0, 1)
        flow = None
        if given.flow is not None and memory is not None:
            flow = _pad(given.flow.to(self.device, torch.float32).permute(2, 0, 1)[None], value=torch.nan)
        objects, look = (memory.objects, memory.look) if memory is not None else ({}, None)
        if given.instance is not None:
            now = thin(rgb.permute(2, 0, 1)[None])
            # after a cut an object of the same id is another
            objects, look = objects if look is None or bool(alike(now, look)[0]) else {}, now
        tiles = Tiles.of(torch.ones(height, width) if given.need is None else given.need)
        if tiles.nothing():
            return rgb, replace(self._skipped(memory, (height, width), flow), objects=objects, look=look)
        photos = None
        if given.reference is not None:
            reference, trust = (x.to(rgb) for x in given.reference)
            reference, trust = reference.clamp(0, 1), (trust * tiles.pixels().to(trust))[..., None]
            rgb = torch.lerp(rgb, reference, trust)
            photos = photos_of(*(x.permute(2, 0, 1)[None] for x in (reference, trust)))
        corrections: Corrections = {}
        if given.instance is not None:
            instance = given.instance.to(self.device)
            planes, corrections = correct(self.net.objects, rgb.permute(2, 0, 1), instance, objects)
            rgb = torch.where(tiles.pixels().to(self.device)[..., None], planes.permute(1, 2, 0), rgb)
        if not self.repairs[photos is not None]:
            return rgb.contiguous(), Memory(None, (height, width), given.flow is not None, objects=corrections, look=look)
        padded = _pad(rgb.permute(2, 0, 1)[None], mode="replicate")
        mask = None if given.instance is None else _pad(given.instance.to(self.device, torch.float32)[None, None], value=0)
        photos = None if photos is None else _pad(photos, value=0)
        past = None if memory is None else self._brought(memory, flow, padded)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            if tiles.everything():
                out = self.net(padded, mask, past, photos)
                better, after = out.rgb, out.past
            else:
                better, after = self.net.parts(padded, mask, past, photos, tiles)
        better = better[0, :, :height, :width].permute(1, 2, 0).clamp(0, 1).contiguous()
        return better, Memory(after, (height, width), given.flow is not None, objects=corrections, look=look)

    def _brought(self, memory: Memory, flow: torch.Tensor | None, rgb: torch.Tensor) -> Past | None:
        """The past of a memory as it would look in the frame `rgb`."""
        past = memory.past
        if past is None:
            return None
        past = replace(past, latents=past.latents[:, : self.history], valid=past.valid[:, : self.history])
        for step in (*memory.since, *(() if flow is None else (flow,))):
            past = past.moved(step)
        return past.fitting(rgb)

    def _skipped(self, memory: Memory | None, size: tuple[int, int], flow: torch.Tensor | None) -> Memory:
        """The memory after a frame that needed nothing: its flow is followed when a frame needs the past, unless that is too far back."""
        if memory is None:
            return Memory(None, size, flow is not None)
        since = memory.since if flow is None else (*memory.since, flow)
        flowing = memory.flow or flow is not None
        if memory.past is None or len(since) > LONGEST:
            return Memory(None, size, flowing)
        return Memory(memory.past, size, flowing, since)


def _pad(image: torch.Tensor, **how) -> torch.Tensor:
    """`[1, C, H, W]` grown at the right and bottom to sides that are multiples of 16."""
    height, width = image.shape[-2:]
    return F.pad(image, (0, -width % MULTIPLE, 0, -height % MULTIPLE), **how)
