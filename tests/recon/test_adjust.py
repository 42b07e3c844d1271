"""Poses by which pictures meet, where there is no lidar."""

import numpy as np
import pytest
import torch
from painted import SIZE, drive

from recon.fit.config import FitConfig
from recon.ready import readied
from recon.registration.adjust import adjusted
from recon.registration.align import about
from recon.registration.corrected import MOVED, as_corrected, moved
from recon.sfm import posed
from recon.sfm.colmap import pycolmap
from scenes.poses import inverse, translation, yaw
from scenes.trajectory import Trajectory

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")
ALL = (0, 10**18)


@pytest.fixture(scope="module")
def bare():
    return drive([0.0] + [0.6] * 11)


@pytest.fixture(scope="module")
def jittered(bare):
    """By 3 cm and a tenth of a degree from picture to picture, as GPS does."""
    deltas = np.random.default_rng(0).normal(0, [2e-3] * 3 + [0.03] * 3, (len(bare.ego), 6))
    return moved(bare, Trajectory(bare.ego.times_us, about(bare.ego.world_from_body[:, :3, 3].numpy(), deltas)))


def steps_off(log, truth) -> tuple[float, float]:
    """Metres and degrees, in the mean, by which a camera's steps differ from those of another log."""
    a, b = (inverse(p[:-1]) @ p[1:] for p in (next(iter(of.cameras.values())).world_from_cam for of in (log, truth)))
    off = inverse(a) @ b
    angle = torch.acos(((off.diagonal(dim1=1, dim2=2)[:, :3].sum(1) - 1) / 2).clamp(-1, 1))
    return float(off[:, :3, 3].norm(dim=1).mean()), float(torch.rad2deg(angle).mean())


def test_poses_that_jitter_are_put_where_pictures_meet(bare, jittered, capsys, monkeypatch):
    name = next(iter(bare.cameras))
    better = adjusted(jittered, name, ALL, SIZE)
    assert "its pictures meet within" in capsys.readouterr().err
    (far, turned), (nearer, less) = steps_off(jittered, bare), steps_off(better, bare)
    assert nearer < 0.2 * far and less < 0.2 * turned
    there, was = (log.ego.world_from_body[:, :3, 3] for log in (better, jittered))
    assert (there - was).mean(0).norm() < 0.01, "the world stays where it is"
    again = as_corrected(jittered, {MOVED: better.meta[MOVED]})
    assert torch.equal(again.ego.world_from_body, better.ego.world_from_body) and again.meta[MOVED] == better.meta[MOVED]
    monkeypatch.setattr("recon.ready.adjusted", lambda *_: pytest.fail("sought where pictures meet again"))
    resumed = readied(jittered, (), FitConfig(), [name], ALL, SIZE, {MOVED: better.meta[MOVED]})
    assert torch.equal(resumed.ego.world_from_body, better.ego.world_from_body)
    assert readied(jittered, (), FitConfig(), [name], ALL, SIZE, {MOVED: None}) is jittered


def test_poses_by_which_pictures_meet_stay_as_they_are(bare, jittered):
    name = next(iter(bare.cameras))
    assert adjusted(bare, name, ALL, SIZE) is bare
    assert adjusted(jittered, name, (0, 600_000), SIZE) is jittered, "too few to tell"


@pytest.mark.parametrize(("spread", "kept"), [(0.1, False), (1e-4, True)])
def test_poses_move_as_far_as_positions_may_be_off_and_the_lens_stays(spread, kept, tmp_path, monkeypatch):
    """A hundred points in ten pictures, whose lens is a hundredth too long and which stand some centimetres off."""
    colmap = pycolmap()
    options = colmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=10, num_points2D_without_point3D=0)
    options.camera_model_id, options.camera_params = colmap.CameraModelId.PINHOLE, [1000.0, 1000.0, 512.0, 384.0]
    made = colmap.synthesize_dataset(options)
    truth = {image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in made.images.values()}
    dice, given = np.random.default_rng(0), {}
    for image in made.images.values():
        given[image.name] = truth[image.name].copy()
        given[image.name][:3, 3] += dice.normal(0, 0.03, 3)
        image.frame.set_cam_from_world(image.camera_id, colmap.Rigid3d(given[image.name][:3]))
    (camera,) = made.cameras.values()
    camera.params = [1010.0, 1010.0, 512.0, 384.0]
    made.update_point_3d_errors()
    monkeypatch.setattr(posed, "_match", lambda *_: None)
    monkeypatch.setattr(posed, "_at_poses", lambda *_: made)
    found, before, after = posed.adjust(posed.Posed(tmp_path, {}, given, []), spread)
    places, were, are = (np.stack([np.linalg.inv(of[name])[:3, 3] for name in truth]) for of in (found, given, truth))
    assert after < before and (np.abs(places - were).max() < 0.03) == kept and (np.abs(places - are).max() < 0.03) != kept
    assert camera.params.tolist() == [1010.0, 1010.0, 512.0, 384.0]


@pytest.mark.parametrize(("metres", "moves"), [(0.9, True), (1.1, False)])
def test_a_path_goes_where_its_pictures_meet_but_not_far(bare, metres, moves, monkeypatch):
    """To its left and turned a little, all of it, though the first picture meets no other."""
    name, motion = next(iter(bare.cameras)), translation(0.0, metres, 0.0) @ yaw(0.01)

    def met(pictures, spread):
        poses = {file: np.linalg.inv(motion.numpy() @ np.linalg.inv(pose)) for file, pose in list(pictures.poses.items())[1:]}
        return poses, 1.0, 0.1

    monkeypatch.setattr("recon.registration.adjust.adjust", met)
    better = adjusted(bare, name, ALL, SIZE)
    assert (better is not bare) == moves
    if moves:
        torch.testing.assert_close(better.ego.world_from_body, motion @ bare.ego.world_from_body)
        torch.testing.assert_close(better.camera(name).world_from_cam, motion @ bare.camera(name).world_from_cam)
