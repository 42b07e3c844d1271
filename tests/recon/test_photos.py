import math
import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from made_colmap import pictures_along, relative, write_colmap
from painted import drive as painted_drive
from PIL import Image

from recon import open_log
from recon.defaults import choose
from recon.readers import photos as reader
from recon.readers.colmap_model import read_model
from recon.readers.footage import take_frames
from recon.sfm import solve as sfm
from recon.sfm.colmap import pycolmap
from render.video import VideoWriter
from scenes.pictures import ORIENTATION
from scenes.poses import pose_from

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


SHADES = torch.linspace(0, 1, 96)[None, :, None].expand(54, 96, 3)


@pytest.fixture(scope="module")
def walk(street, tmp_path_factory):
    return write_colmap(tmp_path_factory.mktemp("photos") / "walk", street, {"": pictures_along(street, count=6)})


@pytest.fixture
def solved(walk, monkeypatch):
    """Structure from motion that knows its answer; the calls it got."""
    calls = []

    def solve(pictures, names, workspace, ordered, angle_of_view, source):
        calls.append((names, ordered, angle_of_view))
        shutil.copytree(walk / "sparse", workspace / "sparse")
        images = workspace / "sparse/0/images.txt"
        text = images.read_text()
        for i, name in enumerate(names):
            text = text.replace(f"{i:03d}.png", name)
        images.write_text(text)
        return sfm.Found(None, len(names), 1.0)

    monkeypatch.setattr(reader, "solve", solve)
    return calls


def test_photos_are_placed_once_and_read_from_then_on(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    first, second = open_log(tmp_path / "walk"), open_log(tmp_path / "walk", camera_height=1.5)
    assert len(solved) == 1 and solved[0][1] is False and (tmp_path / "walk.sfm/sparse/0").is_dir()
    assert [f.parent.name for f in first.camera("camera").files] == ["walk"] * 6
    assert first.meta["metric"] is False and second.meta["metric"] is True


def test_a_known_angle_of_view_is_kept_and_another_one_begins_anew(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    camera = open_log(tmp_path / "walk").camera("camera")
    angle = 2 * math.atan(camera.width / 2 / camera.lens.focal()[0])
    assert solved[0][2] is None
    open_log(tmp_path / "walk", angle_of_view=1.005 * angle)
    assert len(solved) == 1
    with pytest.raises(ValueError, match="walk.sfm was made with an angle of view of .*delete it to begin again with 20deg"):
        open_log(tmp_path / "walk", angle_of_view=math.radians(20))
    shutil.rmtree(tmp_path / "walk.sfm")
    open_log(tmp_path / "walk", angle_of_view=angle)
    assert solved[1][2] == angle
    with pytest.raises(ValueError, match="from 5deg to 150deg, got 200deg"):
        open_log(tmp_path / "walk", angle_of_view=math.radians(200))


def test_who_knows_his_lenses_needs_no_angle_of_view(walk, drive):
    for path in (walk, drive):
        with pytest.raises(ValueError, match="leave out --angle-of-view"):
            open_log(path, angle_of_view=1.0)


def test_photos_are_in_the_order_of_their_numbers(walk, solved, tmp_path):
    (tmp_path / "walk").mkdir()
    for i in range(6):
        shutil.copy(walk / f"images/{i:03d}.png", tmp_path / f"walk/shot{i + 7}.png")
    camera = open_log(tmp_path / "walk").camera("camera")
    assert solved[0][0] == [f.name for f in camera.files] == [f"shot{i + 7}.png" for i in range(6)]


def test_photos_of_another_size_are_left_out_and_said(walk, solved, tmp_path, capsys):
    shutil.copytree(walk / "images", tmp_path / "walk")
    Image.new("RGB", (54, 96)).save(tmp_path / "walk/turned.png")
    open_log(tmp_path / "walk")
    assert len(solved[0][0]) == 6 and "left out turned.png: not 96x54" in capsys.readouterr().err


def test_photos_of_as_many_sizes_are_refused_for_that(tmp_path):
    (tmp_path / "walk").mkdir()
    for i in range(5):
        Image.new("RGB", (96 + i // 2, 54)).save(tmp_path / f"walk/{i}.png")
    with pytest.raises(ValueError, match="walk has 5 photos, of which no 3 are of one size in pixels; scale or cut them to one"):
        open_log(tmp_path / "walk")
    assert not (tmp_path / "walk.sfm").exists()


def test_photos_of_a_kind_that_is_not_read_are_said(walk, solved, tmp_path, capsys):
    (tmp_path / "phone").mkdir()
    for name in ("IMG_1.HEIC", "IMG_2.HEIC", "3.webp", "._IMG_1.HEIC"):
        (tmp_path / "phone" / name).write_bytes(b"some")
    with pytest.raises(
        ValueError, match=r"phone holds (2 \.HEIC pictures and 1 \.webp picture|1 \.webp picture and 2 \.HEIC pictures), .*\.jpg"
    ):
        open_log(tmp_path / "phone")
    with pytest.raises(ValueError, match=r"IMG_1\.HEIC is 1 \.HEIC picture, which are not read; export them as \.jpg"):
        open_log(tmp_path / "phone" / "IMG_1.HEIC")
    shutil.copytree(walk / "images", tmp_path / "walk")
    (tmp_path / "walk" / "IMG_1.HEIC").touch()
    open_log(tmp_path / "walk")
    assert len(solved[0][0]) == 6 and "left out 1 .HEIC picture, which are not read" in capsys.readouterr().err


def test_a_photo_of_which_a_part_is_missing_is_named_before_poses_are_sought(walk, solved, tmp_path):
    (tmp_path / "walk").mkdir()
    for file in (walk / "images").iterdir():
        Image.open(file).save(tmp_path / "walk" / f"{file.stem}.jpg")
    cut = tmp_path / "walk/002.jpg"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2 + 300])  # its header, of 600 bytes, is whole
    with pytest.raises(ValueError, match=r"002\.jpg does not decode as an image .*; fetch the file again, or take it away"):
        open_log(tmp_path / "walk")
    assert not solved and not (tmp_path / "walk.sfm").exists()


def test_what_a_mac_leaves_among_photos_is_none(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    (tmp_path / "walk/._000.png").write_bytes(b"\x00\x05\x16\x07")
    open_log(tmp_path / "walk")
    assert solved[0][0] == [f"{i:03d}.png" for i in range(6)]


def test_photos_that_nothing_ties_together_are_refused(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    with pytest.raises(ValueError, match=r"m from one to the next, which is implausible; check the scale"):
        open_log(tmp_path / "walk", metres_per_unit=1e5)
    with pytest.raises(ValueError, match=r"implausible; take pictures closer together.*delete .*walk.sfm to begin again"):
        open_log(tmp_path / "walk", camera_height=2000.0)  # as where the ground seems to lie right beneath


def _lie_down(folder: Path) -> None:
    """Store all photos but the first as a phone held upright does: turned to the left, with EXIF that says so."""
    for file in sorted(folder.iterdir())[1:]:
        with Image.open(file) as photo:
            exif = Image.Exif()
            exif[ORIENTATION], exif[0x010F] = 6, "Maker"
            photo.transpose(Image.Transpose.ROTATE_90).save(file, exif=exif)


def test_photos_that_lie_on_their_side_are_read_upright(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    _lie_down(tmp_path / "walk")
    camera = open_log(tmp_path / "walk").camera("camera")
    assert len(solved[0][0]) == 6 and {f.parent for f in camera.files} == {tmp_path / "walk.sfm/images"}
    for i, file in enumerate(camera.files):
        with Image.open(walk / "images" / file.name) as photo, Image.open(file) as kept:
            assert np.array_equal(camera.image(i), np.asarray(photo))
            assert ORIENTATION not in kept.getexif()
            assert i == 0 or kept.getexif()[0x010F] == "Maker"  # COLMAP asks it for the focal length
    assert open_log(tmp_path / "walk").camera("camera").files == camera.files and len(solved) == 1


def test_a_workspace_of_photos_that_lay_on_their_side_is_refused_with_the_fix(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    open_log(tmp_path / "walk")
    _lie_down(tmp_path / "walk")
    with pytest.raises(ValueError, match="walk.sfm was made of photos as they are stored, and 001.png is not stored upright; delete it"):
        open_log(tmp_path / "walk")


def test_frames_of_a_video_that_are_unevenly_apart_keep_their_times(tmp_path):
    """A phone films fast in the light and slowly in the dark: 30 frames in the first second, then 10 in two."""
    import av

    at = [round(1000 * i / 30) for i in range(30)] + [1000 + 200 * i for i in range(10)]
    with av.open(str(tmp_path / "uneven.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.codec_context.time_base = 96, 54, "yuv420p", Fraction(1, 1000)
        for i, ms in enumerate(at):
            frame = av.VideoFrame.from_ndarray((SHADES * (i + 6) * 5).numpy().astype(np.uint8), format="rgb24")
            frame.pts, frame.time_base = ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    times = take_frames(tmp_path / "uneven.mp4", tmp_path / "frames").times
    assert all(t == pytest.approx(1000 * at[int(name[:6])], abs=1000) for name, t in times.items())
    assert {f"{i:06d}.jpg" for i in range(30, 40)} <= times.keys() and len(times) <= 30


def test_many_photos_are_matched_in_the_order_of_their_numbers(tmp_path, monkeypatch):
    """COLMAP's matcher goes by the alphabet, in which a walk's second photo is its tenth."""
    colmap = pycolmap()
    names = [f"IMG ({i}).jpg" for i in range(1, 13)]
    for i, name in enumerate(names):
        Image.fromarray(np.random.default_rng(i).integers(0, 255, (64, 96, 3)).astype(np.uint8)).save(tmp_path / name)
    database, seen = tmp_path / "database.db", []

    colmap.extract_features(database, tmp_path, names, camera_mode=colmap.CameraMode.SINGLE, device=colmap.Device.cpu)
    before = {i.image_id: i.name for i in _images(colmap, database)}
    monkeypatch.setattr(colmap, "match_sequential", lambda path, **_: seen.extend(_images(colmap, path)))
    sfm._match_neighbours(colmap, database, names, None)
    assert [before[i.image_id] for i in sorted(seen, key=lambda i: i.name)] == names
    assert {i.image_id: i.name for i in _images(colmap, database)} == before


def _images(colmap, database):
    with colmap.Database.open(database) as opened:
        return opened.read_all_images()


def test_a_video_keeps_its_clock(solved, tmp_path):
    with VideoWriter(tmp_path / "drive.mp4", 25, 96, 54) as video:
        for i in range(12):
            video.write(SHADES * (i + 6) / 18)
    camera = open_log(tmp_path / "drive.mp4").camera("camera")
    assert solved[0] == ([f"{i:06d}.jpg" for i in range(0, 12, 2)], True, None)  # 25 frames a second, every second one
    assert camera.times_us.diff().unique().tolist() == [80_000] and camera.image(1).shape == (54, 96, 3)


def test_a_part_of_a_video_is_placed_by_itself_and_its_start_is_the_videos(solved, tmp_path):
    with VideoWriter(tmp_path / "drive.mp4", 10, 96, 54) as video:
        for i in range(12):
            video.write(SHADES * (i + 6) / 18)
    log = open_log(tmp_path / "drive.mp4", part_us=(400_000, 600_000))
    assert (tmp_path / "drive.mp4.0.4s+0.6s.sfm").is_dir() and solved[0][0] == [f"{i:06d}.jpg" for i in range(4, 10)]
    assert log.name == "drive.mp4" and log.camera("camera").times_us[0] == 400_000
    first, last = choose(log, None, *log.meta["part_us"])[1]
    assert first < 400_000 and last > 900_000


def test_frames_beyond_a_cut_are_told_with_their_times(solved, tmp_path, monkeypatch, capsys):
    with VideoWriter(tmp_path / "drive.mp4", 10, 96, 54) as video:
        for i in range(9):
            video.write(SHADES * (i + 6) / 18)
    really = reader.solve
    names = frozenset(f"{i:06d}.jpg" for i in range(5, 9))
    monkeypatch.setattr(reader, "solve", lambda *given: replace(really(*given), elsewhere=names))
    open_log(tmp_path / "drive.mp4")
    said = "4 of its pictures share nothing with these, from 0.5 s to 0.8 s, as before or after a cut; --start and --duration take another"
    assert said in capsys.readouterr().err


def test_a_video_of_wide_pixels_is_read_with_square_ones(tmp_path):
    """As of camcorders that store 1440x1080 of 1920x1080: a lens has one focal length across and down."""
    for aspect, size in ((Fraction(4, 3), (54, 128)), (Fraction(3, 4), (72, 96))):
        file, folder = tmp_path / f"{aspect.numerator}.mp4", tmp_path / f"frames{aspect.numerator}"
        with VideoWriter(file, 10, 96, 54, pixel_aspect=aspect) as video:
            video.write(SHADES)
        for name in take_frames(file, folder).times:
            picture = torch.from_numpy(np.array(Image.open(folder / name))).float() / 255
            assert picture.shape == (*size, 3)
            # what H.264 and JPEG leave
            torch.testing.assert_close(picture[:, :, 0].mean(0), torch.linspace(0, 1, size[1]), atol=0.04, rtol=0)


def test_a_video_that_is_too_short_is_told_how_many_frames_are_taken(tmp_path):
    for count, said in ((1, "has 1 frame;"), (12, "has 12 frames, of which 2 are taken, 10 a second;")):
        with VideoWriter(tmp_path / f"{count}.mp4", 60, 96, 54) as video:
            for i in range(count):
                video.write(SHADES * (i + 6) / 18)
        with pytest.raises(ValueError, match=f"mp4 {said} a reconstruction needs at least 3: give a longer video"):
            open_log(tmp_path / f"{count}.mp4")


def test_too_few_photos_are_told_from_no_drive_at_all(walk, tmp_path):
    folder = tmp_path / "few"
    folder.mkdir()
    with pytest.raises(ValueError, match="few is not a known layout of a drive"):
        open_log(folder)
    for i, said in enumerate(("holds 1 photo,", "holds 2 photos,")):
        shutil.copy(walk / "images" / f"{i:03d}.png", folder)
        with pytest.raises(ValueError, match=f"few {said} and a reconstruction needs at least 3 of one place; give a folder of as many"):
            open_log(folder)
    with pytest.raises(ValueError, match="001.png is 1 photo, and a reconstruction needs at least 3"):
        open_log(folder / "001.png")


def test_photos_that_lie_in_subfolders_are_found_for_the_fix(walk, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "trip/day 1/street")
    with pytest.raises(ValueError, match=r"not a known layout .* 6 photos lie in .*trip/day 1/street: give that folder, or put all"):
        open_log(tmp_path / "trip")
    (tmp_path / "trip/day 2").mkdir()
    for i in range(2):
        shutil.copy(walk / f"images/{i:03d}.png", tmp_path / "trip/day 2")
    with pytest.raises(ValueError, match=r" 6 photos lie in .*trip/day 1/street, 2 in other folders: give that folder"):
        open_log(tmp_path / "trip")


def test_poses_that_pictures_do_not_agree_with_are_told_with_the_fix(walk, solved, tmp_path, monkeypatch, capsys):
    shutil.copytree(walk / "images", tmp_path / "walk")
    open_log(tmp_path / "walk")
    assert "wrong" not in capsys.readouterr().err
    shutil.rmtree(tmp_path / "walk.sfm")
    really = reader.solve
    monkeypatch.setattr(reader, "solve", lambda *given: replace(really(*given), agreed=0.3))
    open_log(tmp_path / "walk")
    said = capsys.readouterr().err
    assert "walk: where its pictures were taken may be found wrongly: only 30% of what two pictures share" in said
    assert f"more overlap, and delete {tmp_path / 'walk.sfm'} to begin again, with --angle-of-view where it is known" in said


def test_what_cannot_be_placed_leaves_nothing_behind(walk, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ValueError("only 2 of 6 pictures could be placed")

    monkeypatch.setattr(reader, "solve", fail)
    shutil.copytree(walk / "images", tmp_path / "walk")
    with pytest.raises(ValueError, match="only 2 of 6"):
        open_log(tmp_path / "walk")
    assert [p.name for p in tmp_path.iterdir()] == ["walk"]


def test_a_folder_that_cannot_be_written_is_named_with_the_fix(walk, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    shutil.copytree(walk / "images", tmp_path / "walk")
    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(PermissionError, match="walk.sfm .Permission denied.; copy walk to a folder that you can write"):
        open_log(tmp_path / "walk")


def test_pictures_without_overlap_are_refused_with_the_fix(tmp_path):
    folder = tmp_path / "noise"
    folder.mkdir()
    for i in range(3):
        grey = torch.randint(0, 256, (48, 64, 3), generator=torch.Generator().manual_seed(i), dtype=torch.uint8)
        Image.fromarray(grey.numpy()).resize((256, 192)).save(folder / f"{i}.png")
    with pytest.raises(ValueError, match=f"of 3 pictures of {folder} could be placed; take them closer together"):
        open_log(folder)


def lund(shared, folder, knows_lens):
    """Six photos of a street, 4 metres apart."""
    folder.mkdir()
    for i in range(8, 14):
        with Image.open(shared / f"lund/images/{i:02d}.jpg") as photo:
            knows = {"exif": photo.info["exif"]} if knows_lens else {}
            photo.resize((640, 480)).save(folder / f"{i:02d}.jpg", quality=95, **knows)
    return folder


@pytest.mark.parametrize("told", [False, True])
def test_real_photos_are_placed(shared, tmp_path, told):
    """They know the focal length, or their angle of view is told."""
    folder = lund(shared, tmp_path / "street", knows_lens=not told)
    (known,) = read_model(shared / "lund/colmap_sparse").cameras.values()
    angle = 2 * math.atan(known.width / 2 / known.params[0])
    log = open_log(folder, angle_of_view=angle if told else None)
    camera = log.camera("camera")
    if told:
        assert camera.lens.focal()[0] == pytest.approx(known.params[0] * 640 / known.width)
    assert len(camera) >= 3 and len(log.points.xyz) > 50 and camera.lens.kind == "opencv"
    assert torch.isfinite(log.ego.world_from_body).all() and camera.image(0).shape == (480, 640, 3)


def test_the_same_photos_have_the_same_poses_each_time(shared, tmp_path):
    """Matching and mapping draw lots, and threads end in any order."""
    first, second = (open_log(lund(shared, tmp_path / name, knows_lens=False)) for name in ("once", "again"))
    assert torch.equal(first.camera("camera").world_from_cam, second.camera("camera").world_from_cam)
    assert torch.equal(first.camera("camera").lens.params(), second.camera("camera").lens.params())
    assert np.array_equal(first.points.xyz, second.points.xyz)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """The folder and names of pictures of a painted street, of a camera that sees 90 degrees."""
    folder = tmp_path_factory.mktemp("straight")
    camera = painted_drive([0.0] + [0.6] * 7, ("front",)).cameras["front"]
    for i in range(len(camera.files)):
        Image.fromarray(np.asarray(camera.image(i))).save(folder / f"{i:02d}.png")
    return folder, sorted(p.name for p in folder.iterdir())


def test_pictures_that_do_not_tell_their_lens_are_placed_by_a_usual_one(straight, tmp_path, monkeypatch, capsys):
    """A lens that was found by two pictures that lie one behind the other fits no more of them."""
    folder, names = straight
    really, tried = sfm._largest, []

    def largest(colmap, database, pictures, made, options, tell):
        tried.append(options.ba_refine_focal_length)
        return (None, 0) if options.ba_refine_focal_length else really(colmap, database, pictures, made, options, tell)

    monkeypatch.setattr(sfm, "_largest", largest)
    assert sfm.solve(folder, names, tmp_path, True, None, "street.mp4").right == len(names) and tried == [True, True, False]
    camera = next(iter(read_model(tmp_path / "sparse/0").cameras.values()))
    assert camera.params[0] == pytest.approx(160 / math.tan(math.radians(30))) and 0 < abs(camera.params[3]) < sfm.MOST_DISTORTION
    said = capsys.readouterr().err
    assert "a lens of 60deg places 8 of 8, one that is found 0;" in said and "give --angle-of-view" in said


def test_a_lens_is_not_bent_more_than_lenses_are(straight, tmp_path, monkeypatch):
    folder, names = straight
    really = sfm._largest
    monkeypatch.setattr(sfm, "_largest", lambda *given: (None, 0) if given[4].ba_refine_focal_length else really(*given))
    monkeypatch.setattr(sfm, "MOST_DISTORTION", 0.0)
    assert sfm.solve(folder, names, tmp_path, True, None, "street.mp4").right == len(names)
    assert next(iter(read_model(tmp_path / "sparse/0").cameras.values())).params[3] == 0


def test_pictures_that_tell_their_lens_are_placed_once(straight, tmp_path, monkeypatch, capsys):
    folder, names = straight
    monkeypatch.setattr(sfm, "_fix_lens", lambda *_: pytest.fail("placed once more"))
    assert sfm.solve(folder, names, tmp_path, True, None, "street.mp4").right == len(names)
    assert "--angle-of-view" not in capsys.readouterr().err


def test_a_models_pictures_agree_with_it_unless_their_cameras_are_turned(straight, tmp_path, monkeypatch):
    folder, names = straight
    really, agreed = sfm.agreement, []

    def of_both(colmap, database, model, longer):
        turned = colmap.Reconstruction(model)
        for i, image in enumerate(turned.images.values()):
            aside = pose_from([1.0, 0.0, 0.02 * i, 0.0], [0.0, 0.0, 0.0])[:3].numpy()
            image.frame.rig_from_world = colmap.Rigid3d(aside) * image.frame.rig_from_world
        agreed.extend(really(colmap, database, one, longer) for one in (model, turned))
        return agreed[0]

    monkeypatch.setattr(sfm, "agreement", of_both)
    sfm.solve(folder, names, tmp_path, True, None, "street.mp4")
    assert agreed[0] > 0.7 and agreed[1] < 0.3


def test_small_pictures_of_a_real_street_are_placed_as_they_were_taken(shared, tmp_path, capsys):
    """Eight of 320x180, 18 metres straight ahead, of an unknown lens: where matches may be 4 pixels off, some are turned by 40 degrees."""
    camera = open_log(shared / "pandaset/002").camera("front_camera")
    (tmp_path / "street").mkdir()
    for i in range(40, 80, 5):
        with Image.open(camera.files[i]) as photo:
            photo.resize((320, 180), Image.Resampling.LANCZOS).save(tmp_path / f"street/{i}.jpg", quality=92)
    found = open_log(tmp_path / "street").camera("camera")
    assert len(found) == 8 and "wrongly" not in capsys.readouterr().err
    off = relative(found.world_from_cam)[:, :3, :3] @ relative(camera.world_from_cam[40::5])[:, :3, :3].mT
    assert math.degrees(float(torch.acos(((off.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)).max())) < 2


def test_the_folder_one_is_in_is_read_too(walk, solved, tmp_path, monkeypatch):
    inside = shutil.copytree(walk / "images", tmp_path / "walk" / "more").parent
    shutil.copytree(walk / "images", inside, dirs_exist_ok=True)
    monkeypatch.chdir(inside)
    assert open_log(".").name == "walk"
    monkeypatch.chdir(inside / "more")
    assert open_log("..").name == "walk" and len(solved) == 1 and (tmp_path / "walk.sfm").is_dir()


def test_what_is_kept_of_photos_in_a_folder_is_no_model_of_its_own_photos(walk, solved, tmp_path):
    """Nor of a video's frames, which lie in its workspace."""
    shutil.copytree(walk / "images", tmp_path / "trip")
    for inside in ("trip/day.sfm", "trip/clip.mp4.sfm"):
        shutil.copytree(walk / "sparse", tmp_path / inside / "sparse")
    shutil.copytree(walk / "images", tmp_path / "trip/clip.mp4.sfm/images")
    log = open_log(tmp_path / "trip")
    assert len(solved) == 1 and {f.parent.name for f in log.camera("camera").files} == {"trip"}
    assert open_log(tmp_path / "trip/clip.mp4.sfm").name == "clip.mp4", "itself it may be given"


def test_photos_that_came_or_went_since_are_said(walk, solved, tmp_path, capsys):
    photos = shutil.copytree(walk / "images", tmp_path / "walk")
    open_log(photos)
    assert "came since" not in capsys.readouterr().err
    for name in ("900.png", "1000.png"):
        shutil.copy(photos / "000.png", photos / name)
    open_log(photos)
    told = f"2 of its photos came since {photos}.sfm was made, and are left out: 900.png, 1000.png; delete {photos}.sfm"
    assert told in capsys.readouterr().err
    (photos / "003.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"003.png is missing; .*; where it was taken away, delete .*walk.sfm to begin again\.$"):
        open_log(photos)
    (tmp_path / "walk.sfm/photos.json").unlink()  # as of an older version
    shutil.copy(photos / "000.png", photos / "003.png")
    open_log(photos)
    assert len(solved) == 1 and "came since" not in capsys.readouterr().err


def test_photos_below_those_that_are_placed_are_said(walk, solved, tmp_path, capsys):
    photos = shutil.copytree(walk / "images", tmp_path / "walk")
    shutil.copytree(walk / "images", photos / "extra")
    open_log(photos)
    assert f"its own photos were placed; 6 photos lie in {photos / 'extra'}: give that folder" in capsys.readouterr().err


def test_what_else_has_the_workspaces_name_is_left_alone(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    (tmp_path / "walk.sfm").write_text("mine")
    with pytest.raises(FileExistsError, match="walk.sfm is to hold the poses of walk, and holds something else; move or rename it"):
        open_log(tmp_path / "walk")
    assert not solved and (tmp_path / "walk.sfm").read_text() == "mine"
