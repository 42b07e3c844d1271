"""The CUDA kernels: compiled for sm_90 without a GPU, run on the CPU with tiles of one pixel, and on a GPU where there is one."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import warp as wp

from recon.kernels import behind as behind_kernels
from recon.kernels import descent as descent_kernels
from recon.kernels import develop as develop_kernels
from recon.kernels import ground as ground_kernels
from recon.kernels import planes as planes_kernels
from recon.kernels import press as press_kernels
from recon.kernels import scanlines as scanlines_kernels
from recon.kernels import shutter as shutter_kernels
from recon.kernels import sight as sight_kernels
from recon.kernels import ways as ways_kernels
from recon.kernels.agreement import look_kernel
from recon.kernels.similarity import similar_kernel
from render import block_compositing, rasterize
from render.block_compositing import draw_blocks, draw_blocks_backward
from render.bridge import Rasterize
from render.canonical import canonical_frames
from render.chunks import window
from render.compositing import draw, draw_backward
from render.frame_types import RenderConfig
from render.kernels import bin as bin_kernels
from render.kernels import canonical as canonical_kernels
from render.kernels import flow as flow_kernels
from render.kernels import project as project_kernels
from render.kernels import settled as settled_kernels
from render.kernels import shadow as shadow_kernels
from render.kernels import trace as trace_kernels
from render.kernels.canonical import GROUP
from render.kernels.composite_cuda import composite_blocks, composite_blocks_gradient
from render.kernels.composite_cuda_order import order_blocks, order_blocks_gradient
from render.kernels.flow import carry_kernel
from render.kernels.lenses import LENS_FUNCTIONS
from render.kernels.project_lens import lens_kernels
from render.kernels.types import GRADIENTS, TILE, Wanted
from render.order import TileLists, depth_order, tile_lists
from render.projected import Part
from render.rays import exact_rays
from render.settings import Settings
from scenes import Camera, Orthographic, Pinhole, SplatModel
from scenes.poses import translation
from tests.bench.presets import STILL, random_splats, uniform

WIDTH, HEIGHT, CHANNELS = 37, 29, 3
EVERYTHING = Wanted(depth=True, median=True, instance=True, channels=True)
PIXELS = WIDTH * HEIGHT
CPU = torch.device("cpu")
KERNELS = {
    "project": lambda: project_kernels.project,
    "opencv": lambda: lens_kernels(LENS_FUNCTIONS["opencv"], False).forward,
    "moving fisheye": lambda: lens_kernels(LENS_FUNCTIONS["fisheye"], True).forward,
    "moving fisheye backward": lambda: lens_kernels(LENS_FUNCTIONS["fisheye"], True).backward,
    "trace": lambda: trace_kernels.trace_surface,
    "bin": lambda: bin_kernels.emit_pairs,
    "descent": lambda: descent_kernels.descend,
    "develop": lambda: develop_kernels.develop_backward,
    "carry": lambda: carry_kernel(LENS_FUNCTIONS["fisheye"]),
    "see": lambda: flow_kernels.see,
    "shadow": lambda: shadow_kernels.fall,
    "press": lambda: press_kernels.press,
    "sight": lambda: sight_kernels.mark,
    "similarity": lambda: similar_kernel(wp.float32),
    "shutter": lambda: shutter_kernels.carry,
    "agreement": lambda: look_kernel(LENS_FUNCTIONS["opencv"]),
    "march": lambda: ground_kernels.march,
    "look": lambda: planes_kernels.look,
    "compare": lambda: planes_kernels.compare_kernel(3),
    "look along": lambda: ways_kernels.look_along,
    "unlike": lambda: ways_kernels.unlike_kernel(2),
    "scanlines": lambda: scanlines_kernels.add_paths,
    "behind": lambda: behind_kernels.find_corners,
    "frames": lambda: canonical_kernels.make_frames,
    "settled": lambda: settled_kernels.settle,
    "composite": lambda: composite_blocks(EVERYTHING, False, False, TILE),
    "composite backward": lambda: composite_blocks_gradient(EVERYTHING, False, False, TILE),
    "composite along rays": lambda: composite_blocks(EVERYTHING, True, True, TILE),
    "composite along rays backward": lambda: composite_blocks_gradient(EVERYTHING, True, True, TILE),
    "composite by pixel": lambda: order_blocks(EVERYTHING, True, True, TILE),
    "composite by pixel backward": lambda: order_blocks_gradient(EVERYTHING, True, True, TILE),
}


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_compile_for_sm_90(name, tmp_path):
    wp.init()
    module = KERNELS[name]().module
    block_dim = module.options["block_dim"]
    module.options["block_dim"] = TILE * TILE  # a launch sets it
    try:
        files = wp.compile_aot_module(module, device=None, arch=90, module_dir=tmp_path)
    finally:
        module.options["block_dim"] = block_dim
    built = [Path(f) for f in files if Path(f).suffix in (".ptx", ".cubin")]
    assert built and all(f.stat().st_size > 1000 for f in built)


class Captured:
    """What `Rasterize` keeps for backward, outside autograd."""

    saved_tensors = ()

    def mark_non_differentiable(self, *_):
        pass

    def save_for_backward(self, *_):
        pass


def keep_forward(settings: Settings, gaussians, pose: torch.Tensor, lens: Pinhole, features=None, frames=None, rays=None):
    """`Rasterize.forward` outside autograd: what it keeps for backward, and its outputs."""
    kept = Captured()
    kept.needs_input_grad = (True,) * 12
    fields = gaussians.tensors().values()
    return kept, Rasterize.forward(kept, settings, None, pose[None, None], lens.params(), features, frames, rays, *fields)


def whole(settings: Settings):
    return window(0, 0, settings.tiles_x, settings.tiles_y)


def lists_of_every_pixel(kept) -> TileLists:
    """Tiles of one pixel, each of which lists every splat: more than the exact lists."""
    order, n = kept.scene.order, len(kept.scene.order)
    first_slot = torch.zeros(len(kept.scene.records), dtype=torch.int32)
    first_slot[order.long()] = torch.arange(n, dtype=torch.int32) * PIXELS
    slot_of = (torch.arange(n)[None] * PIXELS + torch.arange(PIXELS)[:, None]).reshape(-1).to(torch.int32)
    return TileLists(torch.arange(PIXELS + 1, dtype=torch.int32) * n, order.repeat(PIXELS), slot_of, first_slot)


WAYS = {
    "ray by tile": (SplatModel(response="ray"), "tile", Pinhole(30.0, 30.0, 18.0, 14.0)),
    "conic by pixel": (SplatModel(), "pixel", Pinhole(30.0, 30.0, 18.0, 14.0)),
    "ray by pixel, orthographic": (SplatModel(response="ray"), "pixel", Orthographic(7.0, 7.0, 18.0, 14.0)),
}


@pytest.mark.parametrize("way", WAYS)
def test_block_kernels_agree_with_lane_kernels(way, monkeypatch):
    """One pixel a tile and one thread a block: the CUDA kernels' own arithmetic, on the CPU."""
    monkeypatch.setattr(block_compositing, "SEGMENT", 50)
    model, order, lens = WAYS[way]
    settings = Settings(WIDTH, HEIGHT, model, RenderConfig(order=order), EVERYTHING, (5,), type(lens))
    pose, dice = translation(0, 0, 5), torch.Generator().manual_seed(3)
    # so large and faint that a pixel sees more of them than a round of peeling takes
    g = random_splats(120, 1)
    g = replace(g, log_scales=g.log_scales + 0.6, logit_opacities=g.logit_opacities - 1.5)
    frames = rays = None
    if settings.by_rays:
        frames, (rays, _) = canonical_frames(g, pose), exact_rays(Camera(lens, WIDTH, HEIGHT, STILL), [], False)
    if settings.eyes:  # as if half of the splats moved while the image is read out: they are seen by rays of their own
        rays = torch.cat([rays, rays + 0.002 * torch.randn(rays.shape, generator=dice)])
        frames[60:, GROUP] = 1
    kept, _ = keep_forward(settings, g, pose, lens, torch.randn(120, CHANNELS, generator=dice), frames, rays)
    scene, expected = kept.scene, draw(settings, kept.scene)
    w, lists = window(0, 0, WIDTH, HEIGHT), lists_of_every_pixel(kept)
    planes, picks = torch.empty(len(expected.planes), HEIGHT, WIDTH), torch.empty(2, HEIGHT, WIDTH)
    ends = draw_blocks(settings, w, lists, scene, planes, picks, tile=1)
    assert (planes - expected.planes).abs().max() < 2e-5 * 5  # depths are about 5
    assert ((picks - expected.picks).abs() > 2e-5 * 5).float().mean() < 0.004

    gradients = [torch.randn(n, HEIGHT, WIDTH, generator=dice) for n in (1, 3, 1, 1, CHANNELS)]
    truth = draw_backward(settings, scene, kept.parts, gradients)
    grads = torch.cat(gradients)
    grads[0] *= planes[0]
    slots, channel_slots = torch.empty(len(lists.ids), GRADIENTS), torch.empty(len(lists.ids), CHANNELS)
    g_rays = None if rays is None else torch.zeros_like(rays)
    part = Part(w, lists, None, ends, planes)
    frame_slots = draw_blocks_backward(settings, part, lists, scene, grads, slots, channel_slots, g_rays, tile=1)

    def summed(slots: torch.Tensor) -> torch.Tensor:
        return slots.double().reshape(len(scene.order), PIXELS, -1).sum(1)

    visible = scene.order.long()
    of_splat = torch.repeat_interleave(torch.arange(len(truth.counts)), truth.counts)
    places = torch.repeat_interleave(truth.starts - (truth.counts.cumsum(0) - truth.counts), truth.counts) + torch.arange(len(of_splat))
    values = torch.zeros(len(truth.counts), GRADIENTS, dtype=torch.float64).index_add(0, of_splat, truth.values[places].double())
    pairs = [(summed(slots), values[visible]), (summed(channel_slots), truth.channels[visible])]
    if model.response == "ray":
        pairs += [(summed(frame_slots)[:, :12], truth.frames[visible][:, :12]), (g_rays.flatten(1).T, truth.rays.flatten(1).T)]
    for mine, reference in pairs:
        assert ((mine - reference).abs().amax(0) <= 1e-3 * reference.abs().amax(0) + 1e-9).all()
    again = torch.empty_like(slots)  # no block adds to what another does: the same bits every time
    assert torch.equal(draw_blocks_backward(settings, part, lists, scene, grads, again, channel_slots, g_rays, tile=1), frame_slots)
    assert torch.equal(again, slots)


def test_settled_tiles_are_drawn_by_pixel_as_the_tiles_kernel_draws_them():
    """Flat splats that face the camera at rising depth: no two can change places, so no pixel looks for an order."""
    g, camera, model = uniform(300, WIDTH, HEIGHT)
    frames, (rays, _) = canonical_frames(g, STILL), exact_rays(camera, [], False)
    w, found = window(0, 0, WIDTH, HEIGHT), []
    for order in ("tile", "pixel"):
        settings = Settings(WIDTH, HEIGHT, model, RenderConfig(order=order), Wanted(depth=True), (0,))
        kept, _ = keep_forward(settings, g, STILL, camera.lens, None, frames, rays)
        lists = lists_of_every_pixel(kept)
        planes, slots = torch.empty(6, HEIGHT, WIDTH), torch.empty(len(lists.ids), GRADIENTS)
        ends = draw_blocks(settings, w, lists, kept.scene, planes, torch.empty(0, HEIGHT, WIDTH), tile=1)
        draw_blocks_backward(settings, Part(w, lists, None, ends, planes), lists, kept.scene, planes, slots, slots[:, :0], None, tile=1)
        found.append((planes, slots))
    assert ends[0].all() and all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_sorted_pairs_make_the_same_lists_as_counting():
    """CUDA's way from depth order to tile lists (emit pairs, stable sort by tile), on the CPU, against the counting pass."""
    settings = Settings(WIDTH, HEIGHT, SplatModel(), RenderConfig(), EVERYTHING, (5,))
    kept, _ = keep_forward(settings, random_splats(80, 1), translation(0, 0, 5), Pinhole(30.0, 30.0, 18.0, 14.0), torch.randn(80, 2))
    keys = torch.where(kept.scene.counts > 0, kept.scene.records[:, 10].view(torch.int32), 2**31 - 1).to(torch.int32)
    box = kept.scene.counts + (kept.scene.counts > 0).int() * 3  # as if the boxes around the ellipses had three tiles more
    count, pair = box.clone(), box.clone()
    told = (kept.scene.records, kept.scene.reach, depth_order(keys))
    counted = tile_lists(*told, count, whole(settings), settings.drawn_tiles(CPU))
    paired = tile_lists(*told, pair, whole(settings), settings.drawn_tiles(CPU), counting=False)
    assert torch.equal(count, kept.scene.counts) and torch.equal(pair, kept.scene.counts)
    total = int(counted.starts[-1])
    assert total == int(kept.scene.counts.sum()) > 100
    assert torch.equal(counted.starts, paired.starts)
    places = []
    for lists in (counted, paired):
        ids = lists.ids[:total].long()
        places.append((ids, lists.slot_of[:total] - lists.first_slot[ids]))  # which of its splat's slots, wherever those begin
        assert len(lists.slot_of[:total].unique()) == total, "two entries share a slot"
    for mine, reference in zip(*places, strict=True):
        assert torch.equal(mine, reference)


ON_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
CONFIGS = {
    "by tile": (SplatModel(), RenderConfig()),
    "within 1/255": (SplatModel(), RenderConfig(max_error=1 / 255)),
    "along rays": (SplatModel(response="ray"), RenderConfig()),
    "along rays by pixel": (SplatModel(response="ray"), RenderConfig(order="pixel")),
}


def drawn(way: str, device: str):
    """A frame, and all gradients of a loss on it."""
    from tests.render.test_rasterize import CAMERA, two_instances

    model, config = CONFIGS[way]
    placed = [replace(p, gaussians=p.gaussians.to(device).map(lambda t: t.requires_grad_())) for p in two_instances(1)]
    frame = rasterize(placed, CAMERA, ("rgb", "alpha", "depth", "instance"), model=model, config=config)
    frame.rgb.square().sum().backward()
    return frame, [t.grad.cpu() for p in placed for t in p.gaussians.tensors().values()]


@ON_A_GPU
@pytest.mark.parametrize("way", CONFIGS)
def test_a_gpu_draws_what_the_cpu_draws(way):
    (here, g_here), (there, g_there) = drawn(way, "cpu"), drawn(way, "cuda")
    assert (here.rgb - there.rgb.cpu()).abs().max() < 1e-2 and (here.rgb - there.rgb.cpu()).abs().mean() < 1e-5
    for a, b in zip(g_here, g_there, strict=True):
        assert (a - b).abs().max() < 1e-2 * a.abs().max()


@ON_A_GPU
@pytest.mark.parametrize("way", CONFIGS)
def test_a_gpu_trains_to_the_same_bits_twice(way):
    from tests.render.test_rasterize import CAMERA, two_instances

    model, config = CONFIGS[way]

    def trained() -> list[torch.Tensor]:
        placed = [replace(p, gaussians=p.gaussians.to("cuda").map(lambda t: t.requires_grad_())) for p in two_instances(1)]
        fields = [t for p in placed for t in p.gaussians.tensors().values()]
        steps = torch.optim.Adam(fields, lr=1e-3)
        for _ in range(200):
            steps.zero_grad()
            (rasterize(placed, CAMERA, ("rgb",), model=model, config=config).rgb - 0.5).square().sum().backward()
            steps.step()
        return [t.detach() for t in fields]

    assert all(torch.equal(a, b) for a, b in zip(trained(), trained(), strict=True))
