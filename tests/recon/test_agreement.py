from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from painted import SIZE, depth_of, drive

from recon.fit.agreement import FARTHEST, NEAREST, Agreement
from recon.fit.knots import Knots
from recon.fit.losses import EVERYWHERE
from recon.fit.motion import Motion
from recon.fit.targets import Targets
from recon.views.frames import Frames, load_frames
from render.flow import correspond
from scenes.camera import Camera, RigCamera
from scenes.gaussians import Gaussians, Placed
from scenes.lenses import Fisheye, OpenCV, Pinhole
from scenes.poses import inverse

ALL = (0, 10**18)
STREET = [Placed(Gaussians.empty(), torch.eye(4, dtype=torch.float64))]


def compared(steps=(0.0, 1.0, 1.0, 1.0), names=("front",), metres=1.0, lens=None, readout_us=0, shutter="rows"):
    """Frames of the painted drive, its motion and agreement; pictures are as they were painted, whatever the lens and shutter."""
    log = drive(list(steps), names)
    frames = load_frames(log, list(names), ALL, SIZE, 0)
    rig = {}
    for name in names:
        camera = log.camera(name)
        mount = inverse(log.ego.at(0)) @ camera.world_from_cam[0]
        rig[name] = RigCamera(lens or camera.lens, *SIZE, mount, shutter=shutter if readout_us else "global", readout_us=readout_us)
    motion = Motion(frames, rig, Knots(log.ego), [])
    return frames, motion, Agreement(frames.training(), motion, metres)


def street_of(camera: Camera, times: float = 1.0) -> dict[str, torch.Tensor]:
    """What is drawn where all is as it is painted, but so many times as far off."""
    depth = depth_of(camera).float() * times
    return {"depth": depth, "alpha": torch.ones_like(depth), "instance": torch.zeros_like(depth, dtype=torch.int32)}


def cost(frames: Frames, motion: Motion, agreement: Agreement, drawn, mine=1, its=3):
    views, targets = frames.training(), Targets()
    shot = motion.shot(views[mine], SIZE)
    return agreement.cost(shot, drawn, targets.picture(views[mine], 1), views[its], targets.picture(views[its], 1), EVERYWHERE)


def test_photos_agree_where_depth_is_right_and_tell_which_way_it_is_wrong():
    frames, motion, agreement = compared()
    camera = motion.camera(frames.training()[1])
    slopes, values = {}, {}
    for times in (0.97, 1.0, 1.03):
        drawn = street_of(camera, times)
        drawn["depth"].requires_grad_()
        value = cost(frames, motion, agreement, drawn)
        value.backward()
        values[times] = float(value.detach())
        slopes[times] = float((drawn["depth"].grad * drawn["depth"].detach()).sum())  # by the logarithm of all depths
    assert values[1.0] < 0.6 * min(values[0.97], values[1.03])
    assert slopes[0.97] < -4 * abs(slopes[1.0]) and slopes[1.03] > 4 * abs(slopes[1.0])


def test_its_gradient_is_how_the_difference_changes():
    frames, motion, agreement = compared()
    camera = motion.camera(frames.training()[1])
    drawn = street_of(camera, 1.01)
    drawn["depth"].requires_grad_()
    cost(frames, motion, agreement, drawn).backward()
    slope = (drawn["depth"].grad * drawn["depth"].detach()).double()
    shot = motion.shot(frames.training()[1], SIZE)
    targets, (_, mine, _, its) = Targets(), frames.training()
    pictures = targets.picture(mine, 1), its, targets.picture(its, 1)
    part = 1e-3
    found = [agreement._looked(shot, street_of(camera, 1.01 * times), *pictures, EVERYWHERE)[0] for times in (1.0, 1 + part)]
    counted = slope != 0
    assert counted.float().mean() > 0.5
    change = ((found[1][0] - found[0][0]).double() / part / counted.numel())[counted]
    # where a pixel's point crosses into the photo's next pixel, or is right, its slope changes on the way
    assert ((change - slope[counted]).abs() < 0.02 * change.abs() + 1e-7).float().mean() > 0.8
    assert torch.allclose(change.sum(), slope.sum(), rtol=0.05)


@pytest.mark.parametrize("shutter", ["global", "rows", "columns"])
@pytest.mark.parametrize(
    "lens",
    [Pinhole(160, 160, 160, 90), OpenCV(160, 160, 160, 90, -0.05, 0.01), Fisheye(120, 120, 160, 90)],
    ids=["pinhole", "opencv", "fisheye"],
)
def test_it_looks_where_the_points_stand_in_the_other_photo(lens, shutter):
    """Held against `render.flow`, which knows exactly when each point is read out there."""
    readout = 0 if shutter == "global" else 40_000
    frames, motion, agreement = compared(lens=lens, readout_us=readout, shutter=shutter)
    mine, its = frames.training()[1], frames.training()[2]
    shot, there = motion.shot(mine, SIZE), motion.shot(its, SIZE)
    drawn, targets = street_of(shot.camera), Targets()
    target, photo = targets.picture(mine, 1), targets.picture(its, 1)

    def moving(s):
        first, last = (inverse(pose) for pose in s.backs())
        camera = replace(s.camera, world_from_cam=first)
        return camera if shutter == "global" else replace(camera, world_from_cam_end=last, shutter=shutter)

    at = correspond(STREET, moving(shot), drawn["depth"], drawn["instance"], STREET, moving(there)).pixels
    size = at.new_tensor(SIZE)
    inside = ((at >= 0.5) & (at <= size - 0.5)).all(-1)
    grid = torch.where(inside[..., None], at / size * 2 - 1, 0.0).float()
    seen = F.grid_sample(photo.permute(2, 0, 1)[None], grid[None], align_corners=False)[0].permute(1, 2, 0)
    found, _ = agreement._looked(shot, drawn, target, its, photo, EVERYWHERE)
    both = inside & (found[2] > 0)
    assert both.sum() > 0.98 * inside.sum() > 0.3 * inside.numel()
    off = (found[0] - (seen - target).abs().mean(-1)).abs()[both]
    assert off.quantile(0.99) < 2e-3 and off.max() < 2e-2
    torch.testing.assert_close(found[1][both], (photo - target).abs().mean(-1)[both])
    if shutter != "global":  # the test would tell
        still = agreement._looked(shot.at_once(), drawn, target, its, photo, EVERYWHERE)[0]
        assert (still[0] - found[0])[both].abs().mean() > 1e-3


def test_a_lattice_is_a_part_of_all_pixels():
    frames, motion, agreement = compared()
    _, mine, _, its = frames.training()
    shot, targets = motion.shot(mine, SIZE), Targets()
    told = shot, street_of(shot.camera, 1.01), targets.picture(mine, 1), its, targets.picture(its, 1)
    whole, some = agreement._looked(*told, EVERYWHERE), agreement._looked(*told, (2, 1, 0))
    assert all(torch.equal(a[..., 1::2, ::2], b) for a, b in zip(whole, some, strict=True))


def test_only_what_stands_still_and_is_solid_is_compared():
    frames, motion, agreement = compared()
    drawn = street_of(motion.camera(frames.training()[1]), 1.02)
    for name, value in (("instance", 1), ("alpha", 0.5), ("depth", torch.inf), ("instance", -1)):
        some = {k: v.clone() for k, v in drawn.items()}
        some[name][:, :160] = value
        some["depth"].requires_grad_()
        total = cost(frames, motion, agreement, some)
        total.backward()
        assert (some["depth"].grad[:, :160] == 0).all() and (some["depth"].grad[:, 160:] != 0).float().mean() > 0.3


def test_what_the_camera_takes_along_does_not_count():
    """The recording car's shade looks the same at the same place of every photo, and says nothing of depth; so does the car itself."""
    frames, motion, agreement = compared()
    _, mine, _, its = frames.training()
    part = (slice(130, 180), slice(60, 260))
    shade = torch.rand(50, 200, 3, generator=torch.Generator().manual_seed(3))
    targets, shot = Targets(), motion.shot(mine, SIZE)
    target, photo = targets.picture(mine, 1).clone(), targets.picture(its, 1).clone()
    target[part], photo[part] = shade, shade
    drawn = street_of(shot.camera)
    drawn["depth"].requires_grad_()
    agreement.cost(shot, drawn, target, its, photo, EVERYWHERE).backward()
    inner = drawn["depth"].grad[136:174, 66:254]
    assert (inner == 0).float().mean() > 0.99
    # what is below in this photo is farther below in the next one
    ego = (torch.arange(180) >= 140)[:, None].expand(180, 320)
    drawn = street_of(shot.camera, 1.01)
    drawn["depth"].requires_grad_()
    agreement.cost(shot, drawn, targets.picture(mine, 1), replace(its, ego=ego), targets.picture(its, 1), EVERYWHERE).backward()
    assert (drawn["depth"].grad[138:] == 0).all() and (drawn["depth"].grad[60:110] != 0).float().mean() > 0.3


def test_photos_are_of_one_camera_and_neither_too_near_nor_too_far():
    steps = (0.0, 0.1, 0.5, 0.5, 0.5, 3.0)
    frames, motion, agreement = compared(steps, ("front", "left"), metres=0.6)
    views = frames.training()
    eyes = {(v.camera, v.index): motion.camera(v).world_from_cam[:3, 3] for v in views}
    for v in views:
        for other in views:
            way = float((eyes[v.camera, v.index] - eyes[other.camera, other.index]).norm())
            is_one = v.camera == other.camera and NEAREST * 0.6 <= way <= FARTHEST * 0.6
            assert is_one == any(o is other for o in agreement.others[v.camera, v.index])
    generator = torch.Generator().manual_seed(0)
    first, last = frames.of(0)[0], frames.of(0)[-1]
    assert agreement.other(last, generator) is None
    assert len({agreement.other(first, generator).index for _ in range(30)}) == len(agreement.others[0, 0]) == 2
