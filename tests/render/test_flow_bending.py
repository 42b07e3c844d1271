"""Flow of what bends: where its surface stands in the other frame."""

from dataclasses import replace

import torch
from street import splats

from render import rasterize
from scenes import Camera, Lattice, Pinhole, Placed
from scenes.poses import inverse, translation
from scenes.scene import bend

CORNERS = torch.tensor([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]])
CAMERA = Camera(
    Pinhole(90.0, 90.0, 48.0, 27.0),
    96,
    54,
    translation(-6.0, 0.0, 1.0) @ torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64),
)


def wall() -> Placed:
    """A dense wall across the view, at x = 0 of its frame, over the whole picture's height and a part of its width."""
    y, z = torch.meshgrid(torch.arange(-1.6, 1.61, 0.05), torch.arange(-0.8, 2.81, 0.05), indexing="ij")
    points = torch.stack([torch.zeros_like(y), y, z], -1).reshape(-1, 3)
    return Placed(splats(points, (0.5, 0.4, 0.3), (0.01, 0.04, 0.04)), translation(0.3, 0.1, 0.0), instance=1)


def lattice(shift: torch.Tensor, lean: float) -> Lattice:
    """All nodes moved by a shift, those at the top by `lean` metres to the left as well."""
    nodes = shift.repeat(2, 2, 2, 1)
    nodes[:, :, 1, 1] += lean
    return Lattice(CORNERS, nodes)


def flow(here: Placed, there: Placed, other: Camera = CAMERA):
    frame = rasterize([here], CAMERA, ("flow_next", "visible_next", "instance", "depth"), flow_to={"next": ([there], other)})
    return frame.flow_next, frame


def test_a_lattice_that_moves_everything_alike_flows_as_a_pose_does():
    shift = torch.tensor([0.2, 0.3, -0.1])
    bent, frame = flow(wall(), bend(wall(), lattice(shift, 0.0)))
    moved, _ = flow(wall(), replace(wall(), world_from_local=translation(0.5, 0.4, -0.1)))
    inside = frame.instance == 1
    assert inside.sum() > 1500
    torch.testing.assert_close(bent[inside], moved[inside], atol=1e-3, rtol=0)


def test_a_surface_that_leans_flows_where_it_leans_to():
    """From one lean to another, seen from elsewhere: each pixel's point goes back to where it stood upright, and on from there."""
    first, then = 0.4, -0.3
    other = replace(CAMERA, world_from_cam=translation(-5.5, 0.2, 1.1) @ translation(6.0, 0.0, -1.0) @ CAMERA.world_from_cam)
    here, there = (bend(wall(), lattice(torch.zeros(3), lean)) for lean in (first, then))
    found, frame = flow(here, there, other)
    rows, columns = torch.meshgrid(torch.arange(8, 46, 3), torch.arange(36, 60, 3), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 2) + 0.5
    rays = CAMERA.lens.unproject(pixels.double())
    points = rays / rays[:, 2:] * frame.depth[pixels[:, 1].long(), pixels[:, 0].long()].double()[:, None]
    local = inverse(here.world_from_local) @ CAMERA.world_from_cam
    local = points @ local[:3, :3].T + local[:3, 3]
    share = local[:, 2].clamp(0, 2) / 2
    local[:, 1] += (then - first) * share
    back = inverse(other.world_from_cam) @ there.world_from_local
    expected = other.lens.project(local @ back[:3, :3].T + back[:3, 3]) - pixels
    torch.testing.assert_close(found[pixels[:, 1].long(), pixels[:, 0].long()].double(), expected, atol=2e-3, rtol=0)
    assert frame.visible_next[pixels[:, 1].long(), pixels[:, 0].long()].float().mean() > 0.95


def test_what_does_not_bend_flows_as_before_beside_what_does():
    still = replace(wall(), instance=0, world_from_local=translation(1.0, 0.0, 0.0))
    alone, _ = flow(still, still, replace(CAMERA, world_from_cam=translation(0.1, 0.2, 0.0) @ CAMERA.world_from_cam))
    narrow = wall()
    some = narrow.gaussians.means[:, 1].abs() < 0.4
    narrow = replace(narrow, gaussians=narrow.gaussians.select(some))
    bent = bend(narrow, lattice(torch.tensor([0.0, 0.3, 0.0]), 0.1))
    other = replace(CAMERA, world_from_cam=translation(0.1, 0.2, 0.0) @ CAMERA.world_from_cam)
    frame = rasterize([still, narrow], CAMERA, ("flow_next", "instance", "alpha"), flow_to={"next": ([still, bent], other)})
    behind = (frame.instance == 0) & (torch.arange(96) < 36)
    assert behind.any()
    torch.testing.assert_close(frame.flow_next[behind], alone[behind], atol=1e-4, rtol=0)
