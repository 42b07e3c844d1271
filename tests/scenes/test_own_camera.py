"""Cameras of one's own: what a file describes is where it says, sees what it says, and is else as a recorded one; or is refused."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from render import render_frame
from scenes import Camera, Fisheye, OpenCV, Pinhole, Trajectory
from scenes.own_camera import own_camera
from scenes.poses import CAM_FROM_FLU, translation, yaw

FRONT, LEFT = "front_camera", "left_camera"


@pytest.fixture
def own(street, tmp_path):
    """The camera that a file of these words describes; text is written as it is."""

    def read(said=None, scene=street, **words):
        file = tmp_path / "roof.json"
        file.write_text(said if isinstance(said, str) else json.dumps(words))
        return own_camera(scene, file)

    return read


def rays(camera, *pixels):
    return camera.lens.unproject(torch.tensor(pixels, dtype=torch.float64))


def test_what_describes_a_recorded_camera_is_drawn_bit_by_bit_as_that(street, own):
    front = street.rig[FRONT]
    exact = {name: float(getattr(front.lens, name)) for name in ("fx", "fy", "cx", "cy")}
    named = own(like=FRONT, **exact, size=[front.width, front.height], moved_m=[0, 0, 0], lens="pinhole")
    varied = replace(street, rig=street.rig | {LEFT: replace(street.rig[LEFT], gains=torch.linspace(0.5, 2, 24).reshape(8, 3))})
    moment = int(street.frame_times(LEFT)[5])
    for scene, name, camera in ((street, FRONT, named), (street, LEFT, own(like=LEFT)), (varied, LEFT, own(scene=varied, like=LEFT))):
        with_own = replace(scene, own={"roof.json": camera})
        frames = [render_frame(with_own, with_own.camera(which, moment), ("rgb", "need")) for which in (name, "roof.json")]
        for output in ("rgb", "need"):
            assert torch.equal(getattr(frames[0], output), getattr(frames[1], output)), (name, output)
            assert torch.equal(
                getattr(frames[0], output), getattr(render_frame(scene, scene.camera(name, moment), ("rgb", "need")), output)
            )


def test_a_flat_field_is_of_a_lens_and_of_where_it_looks(street, own):
    lit = replace(street, rig=street.rig | {FRONT: replace(street.rig[FRONT], flat_field=torch.full((9, 16, 3), 0.8))})
    assert own(scene=lit, like=FRONT, moved_m=[0, 0, 0.5]).flat_field is lit.rig[FRONT].flat_field
    for words in ({"yaw_deg": 40}, {"angle_of_view_deg": 80}, {"size": [64, 64]}):
        assert own(scene=lit, like=FRONT, **words).flat_field is None


def test_a_camera_turned_by_90_degrees_sees_what_one_made_by_hand_does(street, own):
    moment = int(street.frame_times(FRONT)[3])
    pose = street.ego.at(moment) @ translation(1.0, 0.0, 1.5) @ yaw(math.pi / 2)
    pose[:3, :3] = pose[:3, :3] @ CAM_FROM_FLU[:3, :3].T
    by_hand = Camera(Pinhole(40.0, 40.0, 40.0, 30.0), 80, 60, pose, time_us=moment)
    mine = replace(own(yaw_deg=90, angle_of_view_deg=90, size=[80, 60]), trained_focal=None)
    shown = render_frame(street, mine.along(street.ego, moment)).rgb
    assert (shown - render_frame(street, by_hand).rgb).abs().max() < 1e-5


@pytest.mark.parametrize(
    ("angles", "ahead", "up"),
    [({"yaw_deg": 45}, (1, 1, 0), (0, 0, 1)), ({"pitch_deg": 45}, (1, 0, 1), (-1, 0, 1)), ({"roll_deg": 45}, (1, 0, 0), (0, -1, 1)),
     ({"yaw_deg": 90, "pitch_deg": -45}, (0, 1, -1), (0, 1, 1))],
)  # fmt: skip
def test_angles_are_to_the_left_up_and_to_the_right(own, angles, ahead, up):
    axes = own(**angles).body_from_cam[:3, :3]
    for axis, expected in ((axes[:, 2], ahead), (-axes[:, 1], up)):
        assert axis.tolist() == pytest.approx([v / math.hypot(*expected) for v in expected], abs=1e-12)


def test_angles_that_are_not_given_are_those_of_the_camera_that_it_is_like(own):
    axes = own(like=LEFT, pitch_deg=-30).body_from_cam[:3, :3]
    side, down = math.cos(math.pi / 6) / math.sqrt(2), -0.5
    assert axes[:, 2].tolist() == pytest.approx([side, side, down])
    level = own(like=LEFT, yaw_deg=45, pitch_deg=0, roll_deg=0).body_from_cam
    assert (level - own(like=LEFT).body_from_cam).abs().max() < 1e-12


def test_places_are_metres_from_the_camera_that_it_is_like_or_above_the_ground(street, own):
    assert own(moved_m=[0.5, -0.25, 1]).body_from_cam[:3, 3].tolist() == [1.5, -0.25, 2.5]
    tilt = torch.eye(4, dtype=torch.float64)
    tilt[0, 0] = tilt[2, 2] = math.cos(0.1)
    tilt[0, 2], tilt[2, 0] = -math.sin(0.1), math.sin(0.1)  # nose up by 6 degrees, the body 0.3 m above the ground
    poses = translation(0.0, 0.0, 0.3) @ street.ego.world_from_body @ tilt
    steep = replace(street, ego=Trajectory(street.ego.times_us, poses))
    camera = own(scene=steep, height_m=0.5, moved_m=[3, 0, 0])
    assert float((poses[2] @ camera.body_from_cam)[2, 3]) == pytest.approx(0.5, abs=0.01)


def test_lenses_see_across_what_the_file_says(own):
    for kind, angle in (("pinhole", 120), ("fisheye", 120), ("fisheye", 250)):
        camera = own(angle_of_view_deg=angle, lens=kind, size=[200, 100])
        assert type(camera.lens) is {"pinhole": Pinhole, "fisheye": Fisheye}[kind]
        left, right = rays(camera, (0, 50), (200, 50))
        seen = torch.atan2(right[0], right[2]) - torch.atan2(left[0], left[2])
        assert math.degrees(float(seen)) == pytest.approx(angle)


def test_a_recorded_lens_is_kept_at_another_size(street, own):
    """With square pixels, and rows more above and below."""
    camera, front = own(size=[192, 192]), street.rig[FRONT]
    assert camera.lens == Pinhole(2 * front.lens.fx, 2 * front.lens.fy, 2 * front.lens.cx, 96.0)
    assert own(like=FRONT, size=[48, 27]).lens == front.resized(48, 27).lens


def test_a_recorded_lens_gives_its_angle_of_view_to_one_of_another_kind(street, own):
    bent = OpenCV(60.0, 60.0, 48.0, 27.0, -0.2)
    scene = replace(street, rig={FRONT: replace(street.rig[FRONT], lens=bent)})
    assert own(scene=scene, like=FRONT).lens == bent
    for kind in ("pinhole", "fisheye"):
        camera = own(scene=scene, lens=kind)
        right = rays(camera, (96, 27))[0]
        assert float(torch.atan2(right[0], right[2])) == pytest.approx(
            float(torch.atan(bent.unproject(torch.tensor([96.0, 27]))[0])), rel=1e-6
        )
    kept = replace(street, rig={FRONT: replace(street.rig[FRONT], lens=Fisheye(30.0, 30.0, 48.0, 27.0, 0.1))})
    assert own(scene=kept, angle_of_view_deg=100).lens.kind == "fisheye"


def test_calibrated_lenses_are_read_in_opencvs_order(own):
    exact = {"fx": 50, "fy": 51.5, "cx": 47, "cy": 26, "size": [96, 54]}
    assert own(**exact).lens == Pinhole(50, 51.5, 47, 26)
    assert own(**exact, distortion=[-0.3, 0.1, 1e-3, 2e-3, 0.01]).lens == OpenCV(50, 51.5, 47, 26, -0.3, 0.1, 1e-3, 2e-3, 0.01)
    assert own(**exact, lens="fisheye", distortion=[0.1, 0, 0, 0.2]).lens == Fisheye(50, 51.5, 47, 26, 0.1, 0, 0, 0.2)


def test_splats_are_drawn_as_for_the_camera_that_looks_the_same_way(street, own):
    """To a degree; of several, for the one that it is like, or the sharpest: too wide costs more than too narrow."""
    left = street.rig[LEFT]
    tele = replace(street.rig[FRONT], lens=left.lens.scaled(4, 4))
    scene = replace(street, rig=street.rig | {LEFT: replace(left, lens=left.lens.scaled(2, 2)), "tele": tele})
    wide, side = street.rig[FRONT].lens.fx, 2 * left.lens.fx
    assert own(scene=scene, angle_of_view_deg=150).trained_focal == wide
    assert own(scene=scene, like=LEFT, yaw_deg=0).trained_focal == 2 * side
    assert own(scene=scene, yaw_deg=30).trained_focal == side and own(scene=scene, yaw_deg=10).trained_focal == wide
    nobody = replace(street, rig={name: replace(c, fitted=False) for name, c in street.rig.items()})
    assert own(scene=nobody, yaw_deg=0).trained_focal is None


BAD = [
    ("", "line 1: Expecting value, so it is no JSON"),
    ('{"yaw_deg": 45,}', "line 1: "),
    ("{}", 'describes no camera; write one or more of like, lens, moved_m,'),
    ("[1]", "describes no camera"),
    ({"yaw": 45}, 'has the unknown key "yaw"; there are like,'),
    ({"hight_m": 1}, "Did you mean height_m?"),
    ('{"yaw_deg": 1, "yaw_deg": 2}', "says yaw_deg twice"),
    ({"yaw_deg": "45deg"}, 'yaw_deg is "45deg", but it takes a number, without units; write it as 45'),
    ({"yaw_deg": True}, "yaw_deg is true"),
    ('{"yaw_deg": NaN}', "yaw_deg is NaN"),
    ('{"yaw_deg": 1e999}', "yaw_deg is Infinity"),
    ({"pitch_deg": 95}, "pitch_deg is 95, but it can be from -90 to 90; the nearest is 90"),
    ({"size": [0, 54]}, "size is [0, 54], but it can be from 1 to 16384; the nearest is 1"),
    ({"size": [96.5, 54]}, "it takes a list of 2 whole numbers"),
    ({"size": "640x360"}, "write it as [1280, 720]"),
    ({"moved_m": 0.5}, "it takes a list of 3 numbers"),
    ({"moved_m": [0, 0, 500]}, "the nearest is 100"),
    ({"moved_m": [0, 0, -1.6]}, "moved_m puts it 0.10 m below the ground; move it down by less than 1.50"),
    ({"height_m": 0}, "the nearest is 0.01"),
    ({"height_m": 1, "moved_m": [0, 0, 1]}, "write 0 there, or no height_m"),
    ({"like": "frnt"}, 'camera "frnt" is not in the rig; it has front_camera, left_camera. Did you mean front_camera?'),
    ({"like": 3}, "it takes a name"),
    ({"lens": "fish"}, 'lens "fish" is not one of pinhole, fisheye. Did you mean fisheye?'),
    ({"angle_of_view_deg": 190}, 'a pinhole lens of 96x54 pixels sees at most 179; write that, or "lens": "fisheye", which sees up to 313'),
    ({"angle_of_view_deg": 300, "lens": "fisheye", "size": [80, 80]}, "a fisheye lens of 80x80 pixels sees at most 254; write that"),
    ({"angle_of_view_deg": 0}, "the nearest is 1"),
    ({"fx": 50, "fy": 50}, "gives fx, fy without cx, cy, size"),
    ({"distortion": [0, 0, 0, 0]}, "gives distortion without fx, fy, cx, cy, size"),
    ({"fx": 50, "fy": 50, "cx": 48, "cy": 27, "size": [96, 54], "angle_of_view_deg": 60}, "leave out one of them"),
    ({"fx": 50, "fy": 50, "cx": 48, "cy": 27, "size": [96, 54], "distortion": [0, 0, 0]}, "a list of 4 or 5 or 8 or 12 numbers"),
    ({"fx": 50, "fy": 50, "cx": 48, "cy": 27, "size": [96, 54], "distortion": [0.1] * 5, "lens": "fisheye"}, "the 4 of OpenCV's fisheye"),
    ({"fx": -50, "fy": 50, "cx": 48, "cy": 27, "size": [96, 54]}, "fx is -50, but it can be from 1"),
]  # fmt: skip


@pytest.mark.parametrize(("said", "message"), BAD, ids=[str(case[0])[:40] for case in BAD])
def test_bad_files_are_refused_with_file_key_and_fix(own, said, message):
    with pytest.raises(ValueError) as refused:
        own(said) if isinstance(said, str) else own(**said)
    assert "roof.json" in str(refused.value) and message in str(refused.value)


def test_what_needs_metres_or_a_ground_is_refused_of_a_scene_without(street, own, tmp_path):
    bare = replace(street, meta=street.meta | {"metric": False})
    for words in ({"moved_m": [0, 0, 1]}, {"height_m": 1}):
        with pytest.raises(ValueError, match=r"roof\.json: (moved_m|height_m) is in metres, but street has no metric scale"):
            own(scene=bare, **words)
    assert own(scene=bare, yaw_deg=20).width == 96
    with pytest.raises(ValueError, match="height_m needs a scene whose ground is known; say by moved_m"):
        own(scene=replace(street, ground=None), height_m=1)
    (tmp_path / "roof.json").unlink()
    (tmp_path / "roof.jsn").write_bytes(b"\xff\xfe")
    with pytest.raises(FileNotFoundError, match=r"roof\.json does not exist\. Did you mean roof\.jsn\?"):
        own_camera(street, tmp_path / "roof.json")
    with pytest.raises(ValueError, match="not a text file in UTF-8"):
        own_camera(street, Path(tmp_path / "roof.jsn"))
