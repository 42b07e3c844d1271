import numpy as np
import pytest
import torch
from painted import SIZE, depth_of, drive

from recon.readers.colmap import lens_of
from recon.readers.colmap_model import ModelCamera
from recon.seeds.triangulate import matched, triangulated
from recon.sfm import posed
from recon.sfm.colmap import pycolmap
from recon.sfm.posed import Posed, colmap_lens
from recon.views.frames import load_frames
from recon.views.project import project
from recon.views.view import View
from scenes.lenses import Fisheye, FTheta, OpenCV, Pinhole
from scenes.poses import inverse

ALL = (0, 10**18)

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


@pytest.fixture(scope="module")
def bare():
    return drive([0.0] + [0.6] * 8)


@pytest.fixture(scope="module")
def found(bare):
    frames = load_frames(bare, list(bare.cameras), ALL, SIZE, 8)
    return frames, triangulated(bare, frames)


def test_points_of_a_drive_without_lidar_stand_where_it_shows_them(bare, found):
    frames, points = found
    off = []
    for view in frames.training():
        name = frames.names[view.camera]
        camera = bare.camera(name).camera(view.index, *SIZE)
        row, column, z, inside = project(points.xyz[points.seen[name][view.index]], inverse(camera.world_from_cam).numpy(), camera)
        assert inside.all()
        off.append(np.abs(z / depth_of(camera).numpy()[row, column] - 1))
    assert len(points.xyz) > 500 and sum(map(len, off)) > 3 * len(points.xyz)
    assert np.median(np.concatenate(off)) < 0.01


def test_the_same_pictures_have_the_same_points_each_time(bare, found):
    frames, points = found
    assert np.array_equal(triangulated(bare, frames).xyz, points.xyz)


def test_pictures_held_out_show_no_points(found):
    frames, points = found
    assert [len(points.seen[frames.names[v.camera]][v.index]) for v in frames.held_out()] == [0, 0]


def test_a_picture_that_matches_no_other_shows_no_points(tmp_path, monkeypatch):
    colmap = pycolmap()
    made = colmap.synthesize_dataset(colmap.SyntheticDatasetOptions(num_rigs=1, num_points3D=20))
    names = [image.name for image in made.images.values()]
    monkeypatch.setattr(posed, "_match", lambda *_: None)
    monkeypatch.setattr(posed, "_at_poses", lambda *_: made)
    xyz, seen = posed.triangulate(Posed(tmp_path, {}, dict.fromkeys([*names, "alone"], np.eye(4)), []))
    assert len(xyz) == 20 and seen.pop("alone").tolist() == []
    assert seen.keys() == set(names) and all(shown.tolist() == list(range(20)) for shown in seen.values())


def test_pictures_are_matched_with_the_next_ones_and_with_those_of_their_moment():
    nothing = torch.zeros(0)
    views = [View(c, i, 100_000 * i + 10_000 * c, nothing, False, nothing) for c in range(2) for i in range(4)]
    pairs = matched(views)
    assert {(0, 1), (0, 2), (4, 5), (0, 4), (3, 7)} <= set(pairs) and len(pairs) == len(set(pairs)) == 2 * (3 + 2) + 4
    assert (3, 4) not in pairs and (0, 3) not in pairs


def test_lenses_go_to_colmap_and_back(tmp_path):
    place = 50, 51, 48, 27
    for lens in (Pinhole(*place), OpenCV(*place, 0.1, 0.01, 1e-3, 2e-3, 0.02, 0.1, 0.03, 0.01), Fisheye(*place, 0.1)):
        model, params = colmap_lens(lens, tmp_path)
        assert lens_of(ModelCamera(model, 96, 54, params), tmp_path) == lens
    with pytest.raises(ValueError, match="no lidar, and COLMAP.* no lens opencv with thin prisms"):
        colmap_lens(OpenCV(*place, s1=0.1), tmp_path)
    with pytest.raises(ValueError, match="no lens ftheta"):
        colmap_lens(FTheta(48, 27, 60.0), tmp_path)
