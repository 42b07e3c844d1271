"""The CUDA kernels: compiled for sm_90 without a GPU, run on the CPU with tiles of one pixel, and on a GPU where there is one."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import warp as wp

from recon.kernels import descent as descent_kernels
from recon.kernels import develop as develop_kernels
from recon.kernels import sight as sight_kernels
from render import rasterize
from render.bridge import Rasterize
from render.bridge import _told as told
from render.chunks import window
from render.frame_types import RenderConfig
from render.kernels import bin as bin_kernels
from render.kernels import project as project_kernels
from render.kernels import trace as trace_kernels
from render.kernels.composite_cuda import composite_blocks, composite_blocks_gradient
from render.kernels.lenses import LENS_FUNCTIONS
from render.kernels.project_lens import lens_kernels
from render.kernels.types import GRADIENTS, TILE, Wanted
from render.launch import run, run_blocks, view
from render.order import depth_order, tile_lists
from render.settings import Settings
from scenes import Pinhole, SplatModel
from scenes.poses import translation
from tests.bench.presets import random_splats

WIDTH, HEIGHT, CHANNELS = 37, 29, 3
EVERYTHING = Wanted(depth=True, median=True, instance=True, channels=True)
KERNELS = {
    "project": lambda: project_kernels.project,
    "opencv": lambda: lens_kernels(LENS_FUNCTIONS["opencv"], False).forward,
    "moving fisheye": lambda: lens_kernels(LENS_FUNCTIONS["fisheye"], True).forward,
    "moving fisheye backward": lambda: lens_kernels(LENS_FUNCTIONS["fisheye"], True).backward,
    "trace": lambda: trace_kernels.trace_surface,
    "bin": lambda: bin_kernels.emit_pairs,
    "descent": lambda: descent_kernels.descend,
    "develop": lambda: develop_kernels.develop_backward,
    "sight": lambda: sight_kernels.mark,
    "composite": lambda: composite_blocks(EVERYTHING, TILE),
    "composite backward": lambda: composite_blocks_gradient(EVERYTHING, TILE),
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

    def mark_non_differentiable(self, *_):
        pass


def keep_forward(settings: Settings, gaussians, pose: torch.Tensor, lens: Pinhole, features=None, frames=None, rays=None):
    """`Rasterize.forward` outside autograd: what it keeps for backward, and its outputs."""
    kept = Captured()
    kept.needs_input_grad = (True,) * 12
    fields = gaussians.tensors().values()
    return kept, Rasterize.forward(kept, settings, None, pose[None, None], lens.params(), features, frames, rays, *fields)


def whole(settings: Settings):
    return window(0, 0, settings.tiles_x, settings.tiles_y)


def lane_result():
    """Forward of the lane kernels with everything: settings, kept state, outputs."""
    settings = Settings(WIDTH, HEIGHT, SplatModel(), RenderConfig(), EVERYTHING, (5,))
    features = torch.randn(80, CHANNELS, generator=torch.Generator().manual_seed(2))
    return settings, *keep_forward(settings, random_splats(80, 1), translation(0, 0, 5), Pinhole(30.0, 30.0, 18.0, 14.0), features)


def test_block_kernels_agree_with_lane_kernels():
    """One pixel a tile and one thread a block: the CUDA kernels' own arithmetic, on the CPU."""
    settings, kept, outputs = lane_result()
    generator = torch.Generator().manual_seed(3)
    gradients = [torch.randn(*o.shape, generator=generator) for o in outputs[:5]]
    expected = Rasterize.backward(kept, *gradients, None, None)

    records, features, (group,) = kept.scene.records, kept.scene.features, kept.work.groups
    visible = torch.where(kept.scene.counts > 0, records[:, 10].view(torch.int32), 2**31 - 1).to(torch.int32)
    pixels = WIDTH * HEIGHT
    # every pixel lists every splat: more than the exact lists
    everywhere = torch.where(kept.scene.counts > 0, pixels, 0).to(torch.int32)
    order = torch.argsort(visible, stable=True)[: int((kept.scene.counts > 0).sum())].to(torch.int32)
    n = len(order)
    starts = torch.arange(pixels + 1, dtype=torch.int32) * n
    ids = order.repeat(pixels)
    first_slot = torch.zeros(len(records), dtype=torch.int32)
    first_slot[order.long()] = torch.arange(n, dtype=torch.int32) * pixels
    slot_of = (torch.arange(n)[None] * pixels + torch.arange(pixels)[:, None]).reshape(-1).to(torch.int32)

    planes = torch.empty(EVERYTHING.first_channel + CHANNELS, HEIGHT, WIDTH)
    picks = torch.empty(2, HEIGHT, WIDTH)
    last = torch.empty(HEIGHT, WIDTH, dtype=torch.int32)
    lists = [view(starts, int), view(ids, int)]
    limits = [settings.alpha_max, settings.config.termination]
    scene = [view(records, float), view(features, float), CHANNELS, window(0, 0, WIDTH, HEIGHT)]
    cpu = torch.device("cpu")
    args = [*lists, *scene, *limits, view(planes, float), view(picks, float), view(last, int)]
    run_blocks(composite_blocks(EVERYTHING, 1), pixels, 1, args, cpu)
    rgb, alpha, z, weights, channels, median, instance = outputs
    assert torch.allclose(planes[1:4], rgb, atol=2e-5) and torch.allclose(1 - planes[0], alpha, atol=2e-5)
    assert torch.allclose(planes[4], z, atol=2e-4) and torch.allclose(planes[5], weights, atol=2e-5)
    assert torch.allclose(planes[6:], channels, atol=2e-5)
    assert (picks[0] != median).float().mean() < 0.002
    assert (torch.where(alpha < 0.5, -1, picks[1]).int() != instance).float().mean() < 0.002

    g_rgb, g_alpha, g_z, g_w, g_channels = gradients
    slots, channel_slots = torch.empty(n * pixels, GRADIENTS), torch.empty(n * pixels, CHANNELS)
    grads = torch.cat([-(g_alpha * planes[0])[None], g_rgb, g_z[None], g_w[None], g_channels])
    args = [*lists, view(slot_of, int), *scene, settings.alpha_max, view(planes, float), view(grads, float), view(last, int)]
    run_blocks(composite_blocks_gradient(EVERYTHING, 1), pixels, 1, [*args, view(slots, float), view(channel_slots, float)], cpu)
    out = [torch.empty_like(t) for t in group.fields]
    shared = torch.empty(2, 16)
    types = [wp.vec3, wp.vec4, wp.vec3, float, wp.vec3]
    fields = [view(t, d) for t, d in zip(group.fields, types, strict=True)]
    results = [view(t, d) for t, d in zip(out, types, strict=True)]
    tail = [view(everywhere, int), view(first_slot, int), view(slots, float), *results, view(shared, float)]
    run(project_kernels.project_backward, 2, [*fields, *told(kept.told, kept.rows, group.items), *tail], cpu)
    g_features = torch.zeros_like(features)
    g_features[order.long()] = channel_slots.reshape(n, pixels, CHANNELS).sum(1)
    for mine, reference in zip([g_features, *out], [expected[4], *expected[7:]], strict=True):
        assert (mine - reference).abs().max() < 1e-3 * reference.abs().max()


def test_sorted_pairs_make_the_same_lists_as_counting():
    """CUDA's way from depth order to tile lists (emit pairs, stable sort by tile), on the CPU, against the counting pass."""
    settings, kept, _ = lane_result()
    keys = torch.where(kept.scene.counts > 0, kept.scene.records[:, 10].view(torch.int32), 2**31 - 1).to(torch.int32)
    box = kept.scene.counts + (kept.scene.counts > 0).int() * 3  # as if the boxes around the ellipses had three tiles more
    count, pair = box.clone(), box.clone()
    told = (kept.scene.records, kept.scene.reach, depth_order(keys))
    counted = tile_lists(*told, count, whole(settings), settings.drawn_tiles())
    paired = tile_lists(*told, pair, whole(settings), settings.drawn_tiles(), counting=False)
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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU: renders there and compares with the CPU")
def test_a_gpu_draws_what_the_cpu_draws():
    from tests.render.test_rasterize import CAMERA, two_instances

    def gradients(device):
        placed = [replace(p, gaussians=p.gaussians.to(device).map(lambda t: t.requires_grad_())) for p in two_instances(1)]
        frame = rasterize(placed, CAMERA, ("rgb", "alpha", "depth", "instance"))
        frame.rgb.square().sum().backward()
        return frame, [t.grad.cpu() for p in placed for t in p.gaussians.tensors().values()]

    (here, g_here), (there, g_there) = gradients("cpu"), gradients("cuda")
    assert (here.rgb - there.rgb.cpu()).abs().max() < 1e-2 and (here.rgb - there.rgb.cpu()).abs().mean() < 1e-5
    for a, b in zip(g_here, g_there, strict=True):
        assert (a - b).abs().max() < 1e-2 * a.abs().max()
