"""Hazards of use rather than of splats: threads, interruptions, memory, and bits that must not change.

A conduct is a function that says what went wrong, in words; it stands in the same table as the pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import torch

from render import RenderConfig, bridge, compositing, rasterize
from scenes import Camera, Gaussians, Pinhole, Placed
from scenes.poses import translation
from tests.bench.presets import random_splats
from tests.stress.hazards import SMALL, STILL, ahead

CONDUCT: dict[str, Callable[[str], list[str]]] = {}


def conduct(check: Callable[[str], list[str]]) -> Callable[[str], list[str]]:
    CONDUCT[check.__name__.replace("_", " ")] = check
    return check


def differentiate(placed: Placed, camera: Camera = SMALL, config: RenderConfig = RenderConfig()) -> list[torch.Tensor]:  # noqa: B008 - frozen
    """Picture and gradients."""
    g = placed.gaussians.map(lambda t: t.detach().clone().requires_grad_())
    frame = rasterize(Placed(g, placed.world_from_local), camera, config=config)
    frame.rgb.square().sum().backward()
    return [frame.rgb.detach(), *(t.grad for t in g.tensors().values())]


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@conduct
def renders_in_two_threads_at_once(device: str) -> list[str]:
    clouds = [Placed(random_splats(300, 16 + i).to(device), translation(0, 0, 5)) for i in range(2)]
    alone = [differentiate(c) for c in clouds]
    wrong = []
    with ThreadPoolExecutor(2) as pool:
        for turn in range(5):
            together = pool.map(differentiate, clouds)
            wrong += [f"turn {turn}: cloud {i} differs" for i, got in enumerate(together) if not same(alone[i], got)]
    return wrong


@conduct
def a_render_interrupted_at_any_stage(device: str) -> list[str]:
    (placed,) = ahead(random_splats(200, 15).to(device))
    before, threads = differentiate(placed), torch.get_num_threads()
    wrong = []

    def fail(*_arguments, **_more):
        raise KeyboardInterrupt

    backward = "draw_blocks_backward" if compositing.by_blocks(torch.device(device)) else "_composite_backward"
    stages = [(bridge, "run_each"), (bridge, "depth_order"), (compositing, "tile_lists"), (compositing, "_composite")]
    for room, stage in [*stages, (compositing, backward), (compositing, "_of_part")]:
        kept = getattr(room, stage)
        setattr(room, stage, fail)
        try:
            differentiate(placed)
            wrong.append(f"{stage} was not reached")
        except KeyboardInterrupt:
            pass
        finally:
            setattr(room, stage, kept)
        if torch.get_num_threads() != threads:
            wrong.append(f"after {stage}: {torch.get_num_threads()} threads, not {threads}")
        if not same(before, differentiate(placed)):
            wrong.append(f"after {stage}: another picture")
    return wrong


@conduct
def more_entries_than_are_held_at_once(device: str) -> list[str]:
    """A hundred walls over a 4K image are 3.2 million entries; drawn 2^18 at once."""
    camera = Camera(Pinhole(2000.0, 2000.0, 1920.0, 1080.0), 3840, 2160, STILL)
    g = replace(random_splats(100, 3, sh_count=1), log_scales=torch.full((100, 3), 2.0), logit_opacities=torch.full((100,), -5.0))
    wide = Gaussians(*(t.to(device) for t in g.tensors().values()))
    (placed,) = ahead(wide, 6)
    whole = rasterize(placed, camera).rgb
    parts = rasterize(placed, camera, config=RenderConfig(most_entries=1 << 18)).rgb
    return [] if torch.equal(whole, parts) else [f"windows change the picture by {float((whole - parts).abs().max()):.1e}"]


@conduct
def two_hundred_training_steps_twice(device: str) -> list[str]:
    ends = [train(device) for _ in range(2)]
    return [] if same(*ends) else ["the same training gave other parameters"]


def train(device: str, steps: int = 200) -> list[torch.Tensor]:
    """The parameters after Adam has fitted a cloud to another cloud's picture."""
    target = rasterize(ahead(random_splats(80, 21).to(device)), SMALL).rgb
    g = random_splats(80, 22).to(device).map(lambda t: t.requires_grad_())
    optimizer = torch.optim.Adam(g.tensors().values(), lr=1e-2)
    for _ in range(steps):
        optimizer.zero_grad()
        (rasterize(ahead(g), SMALL, ("rgb",)).rgb - target).abs().mean().backward()
        optimizer.step()
    return [t.detach() for t in g.tensors().values()]
