"""Whole videos."""

import io
from dataclasses import replace
from fractions import Fraction
from shutil import copytree

import av
import numpy as np
import pytest
import torch
from PIL import Image
from small_net import SMALL, stirred

from enhance.clip import enhance_frames, enhance_video, enhancement, telling
from enhance.enhancer import Enhancer
from enhance.network.net import Net
from enhance.network.weights_file import save_net
from render.clip import render_clip
from render.frame_types import Frame
from render.references import References, Shot
from render.video import VideoWriter, read_image, read_video, write_image


@pytest.fixture(scope="module")
def enhancer():
    return Enhancer(Net(SMALL))


def times(scene):
    return scene.frame_times("front_camera")


def write(path, count=4, width=50, height=34):
    with VideoWriter(path, 10, width, height) as video:
        for i in range(count):
            video.write(torch.full((height, width, 3), 0.2 + 0.1 * i))


def test_every_frame_is_enhanced_and_said(tmp_path, enhancer):
    write(tmp_path / "in.mp4")
    told = []
    assert enhance_video(tmp_path / "in.mp4", tmp_path / "out.mp4", enhancer, lambda done, of: told.append((done, of))) == (4, 0)
    out = list(read_video(tmp_path / "out.mp4"))
    assert [round(float(f.mean()), 1) for f in out] == [0.2, 0.3, 0.4, 0.5] and out[0].shape == (34, 50, 3)
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)] and read_video(tmp_path / "out.mp4").fps == 10


def test_frames_keep_their_times_and_the_shape_of_their_pixels(tmp_path, enhancer):
    """As a phone's frames, which come late in the dark, and a camcorder's, whose pixels are wider than high."""
    times_us = [0, 33_000, 66_000, 250_000, 283_000]
    with VideoWriter(tmp_path / "in.mp4", 30, 48, 32, pixel_aspect=Fraction(4, 3)) as video:
        for time_us in times_us:
            video.write(torch.full((32, 48, 3), 0.5), time_us)
    enhance_video(tmp_path / "in.mp4", tmp_path / "out.mp4", enhancer)
    out = read_video(tmp_path / "out.mp4")
    assert [t for t, _ in out.timed()] == pytest.approx(times_us, abs=12) and out.pixel_aspect == Fraction(4, 3)


def test_odd_sizes_gain_the_row_and_column_that_h264_needs(tmp_path, enhancer, capsys):
    with av.open(str(tmp_path / "in.mkv"), "w") as container:
        picture = container.add_stream("ffv1", rate=10)
        picture.width, picture.height, picture.pix_fmt = 33, 19, "bgr0"
        frame = av.VideoFrame.from_ndarray(np.full((19, 33, 3), 90, np.uint8), format="rgb24")
        container.mux([*picture.encode(frame), *picture.encode(None)])
    enhance_video(tmp_path / "in.mkv", tmp_path / "out.mp4", enhancer)
    assert next(iter(read_video(tmp_path / "out.mp4"))).shape == (20, 34, 3)
    assert "out.mp4 has 34x20 pixels for 33x19" in capsys.readouterr().err


def test_that_the_sound_is_left_out_is_said_with_how_to_put_it_back(tmp_path, enhancer, capsys):
    with av.open(str(tmp_path / "in.mp4"), "w") as container:
        sound, picture = container.add_stream("aac", rate=48_000), container.add_stream("libx264", rate=10)
        picture.width, picture.height, picture.pix_fmt = 48, 32, "yuv420p"
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        silence.sample_rate = 48_000
        for stream, frame in ((sound, silence), (picture, av.VideoFrame.from_ndarray(np.full((32, 48, 3), 90, np.uint8), format="rgb24"))):
            container.mux([*stream.encode(frame), *stream.encode(None)])
    enhance_video(tmp_path / "in.mp4", tmp_path / "out.mp4", enhancer)
    told = capsys.readouterr().err
    assert told.count("is without the sound of") == 1 and f"-i {tmp_path / 'in.mp4'} -map 0:v -map 1:a" in told
    enhance_video(tmp_path / "out.mp4", tmp_path / "again.mp4", enhancer)
    assert "without the sound" not in capsys.readouterr().err


def test_an_undecodable_clip_is_refused_and_leaves_nothing(tmp_path, enhancer):
    (tmp_path / "in.mp4").write_bytes(b"no video at all" * 50)
    with pytest.raises(ValueError, match="in.mp4"):
        enhance_video(tmp_path / "in.mp4", tmp_path / "out.mp4", enhancer)
    assert [p.name for p in tmp_path.iterdir()] == ["in.mp4"]


def test_a_clip_that_goes_on_in_another_size_is_refused_by_frame(tmp_path, enhancer):
    """Each picture of motion JPEG has a size of its own."""
    with av.open(tmp_path / "in.mkv", "w") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for i, size in enumerate([(64, 48), (64, 48), (96, 64)]):
            whole = io.BytesIO()
            Image.new("RGB", size, "grey").save(whole, "JPEG")
            packet = av.Packet(whole.getvalue())
            packet.pts = packet.dts = i
            packet.time_base, packet.stream = Fraction(1, 10), stream
            container.mux(packet)
    with pytest.raises(ValueError, match=r"in.mkv changes its size after frame 2, from 64x48 to 96x64; cut it there"):
        enhance_video(tmp_path / "in.mkv", tmp_path / "out.mp4", enhancer)
    assert [p.name for p in tmp_path.iterdir()] == ["in.mkv"]


@pytest.fixture
def pictures(tmp_path):
    """A folder of a clip: a bright square on a grey street, frame 9 before frame 10."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in (8, 9, 10):
        write_image(folder / f"f{i}.png", torch.full((34, 50, 3), 0.4 + 0.01 * i))
    return folder


class Marking:
    """An enhancer that paints what it is told in the colour of its id."""

    about: dict = {}
    reads = ("instance",)
    device = torch.device("cpu")

    def step(self, frame, memory=None):
        if isinstance(frame, torch.Tensor):
            return frame, None
        return torch.where((frame.instance > 0)[..., None], frame.instance[..., None] / 255, frame.rgb), None


def test_a_folder_of_pictures_becomes_one(tmp_path, pictures, capsys):
    assert enhance_video(pictures, tmp_path / "out", Marking()) == (3, 0)
    assert "--instances where objects were inserted" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["f10.png", "f8.png", "f9.png"]
    assert torch.equal(read_image(tmp_path / "out" / "f9.png"), read_image(pictures / "f9.png"))
    with pytest.raises(ValueError, match=r"out.mp4 would be a video; pictures become pictures: name a folder, as -o .*/out"):
        enhance_video(pictures, tmp_path / "out.mp4", Marking())
    with pytest.raises(FileExistsError, match=r"would be replaced, and holds more than pictures \(frames\)"):
        enhance_video(pictures, tmp_path, Marking())
    write_image(pictures / "f11.png", torch.zeros(20, 50, 3))
    with pytest.raises(ValueError, match="f11.png is 50x20, f8.png 50x34"):
        enhance_video(pictures, tmp_path / "other", Marking())
    assert not (tmp_path / "other").exists()
    (pictures / "f11.png").unlink()
    Image.new("RGB", (50, 34)).save(pictures / "f9.tif")
    with pytest.raises(ValueError, match=r"f9.png and f9.tif, which would both become f9.png"):
        enhance_video(pictures, tmp_path / "other", Marking())
    (pictures / "f9.tif").rename(pictures / "f9.jpg")
    write_image(pictures / "f9.k.png", torch.zeros(34, 50, 3))  # sorted, it stands between the two
    with pytest.raises(ValueError, match=r"f9.jpg and f9.png, which would both become f9.png"):
        enhance_video(pictures, tmp_path / "other", Marking())
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no pictures"):
        enhance_video(tmp_path / "empty", tmp_path / "other", Marking())


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (np.full((34, 50, 4), 90, np.uint8), "of f8.png its alpha channel\n"),
        (np.full((34, 50), 3000, np.uint16), "of f8.png all beyond 8 bits of its values\n"),
        (np.full((34, 50, 3), 90, np.uint8), ""),
    ],
)
def test_what_a_pictures_enhanced_one_lacks_is_said(tmp_path, pictures, capsys, picture, said):
    Image.fromarray(picture).save(pictures / "f8.png")
    enhance_video(pictures, tmp_path / "out", Marking())
    errors = capsys.readouterr().err
    assert said in errors and ("is without what" in errors) == bool(said)


@pytest.mark.parametrize("suffix", [".webp", ".tif", ".png"])
def test_a_file_of_several_pictures_is_not_taken_for_one(tmp_path, pictures, capsys, suffix):
    first, *others = (Image.new("RGB", (50, 34), (level, level, level)) for level in (40, 120, 220))
    (pictures / "f9.png").unlink()
    first.save(pictures / f"f9{suffix}", save_all=True, append_images=others)
    enhance_video(pictures, tmp_path / "out", Marking())
    assert f"of f9{suffix} all but the first of its 3 pictures\n" in capsys.readouterr().err
    with pytest.raises(ValueError, match=rf"^{pictures}/f9{suffix} holds 3 pictures, of which only .*; store each .* -coalesce"):
        enhance_video(pictures / f"f9{suffix}", tmp_path / "out.mp4", Marking())
    first.save(pictures / f"f9{suffix}", "MPO", save_all=True, append_images=others)  # as phones store a photo and its preview
    enhance_video(pictures, tmp_path / "out", Marking())
    assert "is without what" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stored", "alpha", "said"),
    [
        ("bgra", 90, "had: its alpha channel\n"),
        ("bgra", 255, ""),
        ("yuv420p10le", 255, "had: all beyond 8 bits of its values\n"),
        ("yuv420p", 255, ""),
    ],
)
def test_what_a_videos_enhanced_one_lacks_is_said(tmp_path, capsys, stored, alpha, said):
    with av.open(str(tmp_path / "in.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 48, 32, stored
        frame = av.VideoFrame.from_ndarray(np.full((32, 48, 4), (90, 90, 90, alpha), np.uint8), format="rgba")
        container.mux([*stream.encode(frame), *stream.encode(None)])
    enhance_video(tmp_path / "in.mkv", tmp_path / "out.mp4", Marking())
    errors = capsys.readouterr().err
    assert said in errors and ("is without what" in errors) == bool(said)


def ids(kind: str, number: int) -> np.ndarray | Image.Image:
    """Object 7 in the columns from `number` on."""
    array = np.zeros((34, 50), np.int32)
    array[:, number:] = 7
    if kind == "array":
        return array - (array == 0)  # -1 is the sky
    if kind == "colour":
        return Image.fromarray((array[..., None] * np.array([0, 0, 1])).astype(np.uint8))
    return Image.fromarray(array.astype(np.uint8 if kind == "grey" else np.uint16))


@pytest.mark.parametrize("kind", ["array", "grey", "deep grey", "colour"])
def test_objects_are_told_picture_by_picture(tmp_path, pictures, kind):
    folder = tmp_path / "ids"
    folder.mkdir()
    for i in (8, 9, 10):
        np.save(folder / f"{i}.npy", ids(kind, i)) if kind == "array" else ids(kind, i).save(folder / f"{i}.png")
    assert enhance_video(pictures, tmp_path / "out", Marking(), instances=folder) == (3, 3)
    for i in (8, 9, 10):
        red = (255 * read_image(tmp_path / "out" / f"f{i}.png")[0, :, 0]).round().int()
        assert (red[:i] != 7).all() and (red[i:] == 7).all()


def test_ids_that_do_not_fit_are_refused(tmp_path, pictures, capsys):
    folder = tmp_path / "ids"
    folder.mkdir()

    def refused(why: str) -> None:
        with pytest.raises(ValueError, match=why):
            enhance_video(pictures, tmp_path / "out", Marking(), instances=folder)
        assert not (tmp_path / "out").exists()

    refused("holds no .npy or .png")
    with pytest.raises(ValueError, match="f9.png is one picture; put it into a folder"):
        enhance_video(pictures / "f9.png", tmp_path / "out", Marking())
    for i in range(3):
        np.save(folder / f"{i}.npy", np.zeros((34, 50), np.int32))
    enhance_video(pictures, tmp_path / "same", Marking(), instances=folder)
    assert f"{folder} has no object" in capsys.readouterr().err
    np.save(folder / "1.npy", np.zeros((30, 50), np.int32))
    refused(r"1.npy has ids of the shape \[30, 50\], but its picture is 34 rows of 50; resize them to 50x34 by nearest neighbour")
    np.save(folder / "1.npy", np.zeros((34, 50)))
    refused("1.npy holds float64; ids are whole numbers")
    np.save(folder / "1.npy", np.arange(34 * 50, dtype=np.int32).reshape(34, 50))
    refused("1.npy has 1699 objects.*without soft edges")
    (folder / "1.npy").write_bytes(b"none")
    refused("1.npy is not an array")
    with (folder / "1.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<i4", "fortran_order": False, "shape": (1 << 40, 50)})
    refused("1.npy is not an array")
    (folder / "1.npy").unlink()
    refused("has ids for 2 pictures, and the clip has 3")


def test_a_folder_above_the_ids_is_refused_with_where_they_are(tmp_path, pictures):
    for kept in ("depth", "instance"):
        (tmp_path / "out" / kept).mkdir(parents=True)
        np.save(tmp_path / "out" / kept / "000000.npy", np.zeros((34, 50), np.int32))
    with pytest.raises(ValueError, match=r"out holds no .npy or .png that say where .*, one a picture; .*/out/instance does$"):
        enhance_video(pictures, tmp_path / "clean", Marking(), instances=tmp_path / "out")


def ids_of(folder, count):
    folder.mkdir()
    for i in range(count):
        np.save(folder / f"{i}.npy", np.zeros((34, 50), np.int32))
    return folder


@pytest.mark.parametrize("told", [3, 5])
def test_ids_for_fewer_or_more_frames_than_a_video_has_are_refused_though_it_tells_no_number(tmp_path, told):
    write(tmp_path / "in.mkv")
    with pytest.raises(ValueError, match=f"ids has ids for {told} pictures, and the clip has"):
        enhance_video(tmp_path / "in.mkv", tmp_path / "out.mp4", Marking(), instances=ids_of(tmp_path / "ids", told))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ids", "in.mkv"]


def test_ids_are_told_for_the_frames_that_a_cut_video_shows(tmp_path):
    """A cut without encoding anew keeps the frames that the first one shown needs, and hides them by an edit list."""
    with VideoWriter(tmp_path / "in.mp4", 10, 50, 34) as video:
        for i in range(6):
            video.write(torch.full((34, 50, 3), 0.1 * i))
    with av.open(str(tmp_path / "in.mp4")) as whole, av.open(str(tmp_path / "cut.mp4"), "w") as cut:
        source = whole.streams.video[0]
        stream = cut.add_stream_from_template(source)
        for packet in whole.demux(source):
            if packet.dts is not None:
                packet.pts, packet.dts, packet.stream = packet.pts - 2 * packet.duration, packet.dts - 2 * packet.duration, stream
                cut.mux(packet)
    with av.open(str(tmp_path / "cut.mp4")) as cut:
        assert cut.streams.video[0].frames == 6
    assert read_video(tmp_path / "cut.mp4").count == len(list(read_video(tmp_path / "cut.mp4"))) == 4
    assert enhance_video(tmp_path / "cut.mp4", tmp_path / "out.mp4", Marking(), instances=ids_of(tmp_path / "four", 4)) == (4, 0)
    with pytest.raises(ValueError, match="six has ids for 6 pictures, and the clip has 4; give one file a picture"):
        enhance_video(tmp_path / "cut.mp4", tmp_path / "other.mp4", Marking(), instances=ids_of(tmp_path / "six", 6))


def test_ids_are_counted_against_frames_that_came_and_not_those_that_a_video_claims(tmp_path, monkeypatch):
    write(tmp_path / "in.mp4")
    monkeypatch.setattr("render.video._shown", lambda stream: 5)
    with pytest.raises(ValueError, match="ids has ids for 5 pictures, and the clip has 4"):
        enhance_video(tmp_path / "in.mp4", tmp_path / "out.mp4", Marking(), instances=ids_of(tmp_path / "ids", 5))
    assert not (tmp_path / "out.mp4").exists()


def test_a_model_that_cannot_be_told_says_so(tmp_path, pictures):
    deaf = Marking()
    deaf.reads, deaf.about = (), {"model": "NVIDIA Fixer"}
    with pytest.raises(ValueError, match="NVIDIA Fixer takes no instance masks; leave out --instances"):
        enhance_video(pictures, tmp_path / "out", deaf, instances=pictures)


def test_a_clip_is_not_written_over_itself(tmp_path, enhancer):
    write(tmp_path / "in.mp4")
    with pytest.raises(ValueError, match="itself"):
        enhance_video(tmp_path / "in.mp4", tmp_path / "in.mp4", enhancer)


@pytest.mark.parametrize(("told", "read"), [("instances", "ids"), ("like", "ids"), ("like", "ids/f9.png")])
def test_a_clip_is_not_written_over_what_it_goes_by(tmp_path, pictures, told, read):
    copytree(pictures, tmp_path / "ids")
    where = "the folder of instances" if told == "instances" else "where the photos are"
    with pytest.raises(ValueError, match=f"ids is {where}; write the enhanced one elsewhere"):
        enhance_video(pictures, tmp_path / "ids", Marking(), **{told: tmp_path / read})
    assert len(list((tmp_path / "ids").iterdir())) == 3


def test_rendered_frames_are_given_what_photos_show(street, tmp_path):
    save_net(Net(SMALL), tmp_path / "untrained.safetensors", {})
    bright = [Shot(street.camera("front_camera", int(t)), lambda w, h: np.full((h, w, 3), 255, np.uint8)) for t in times(street)]
    stages, reads = enhancement(str(tmp_path / "untrained.safetensors"), references=References(bright, street))
    frames = list(render_clip(street, "front_camera", 0.5, times(street)[:3], outputs=reads))
    for before, after in zip(frames, stages["enhance"](stages["references"](iter(frames))), strict=True):
        assert after.rgb.mean() > before.rgb.mean() + 0.2
    without, fewer = enhancement(str(tmp_path / "untrained.safetensors"))
    assert list(without) == ["enhance"]
    assert set(fewer) < set(reads) and torch.equal(next(without["enhance"](iter(frames))).rgb, frames[0].rgb.clamp(0, 1))


def test_it_is_said_where_no_frame_was_changed(tmp_path, enhancer, capsys):
    write(tmp_path / "in.mp4")
    enhance_video(tmp_path / "in.mp4", tmp_path / "same.mp4", Enhancer(Net(SMALL)))
    assert "in.mp4 was changed: give --rendered if it shows renders" in capsys.readouterr().err
    enhance_video(tmp_path / "in.mp4", tmp_path / "photos.mp4", Enhancer(stirred()))
    assert "was changed" in capsys.readouterr().err
    enhance_video(tmp_path / "in.mp4", tmp_path / "rested.mp4", Enhancer(stirred(), repair=False), rendered=True)
    assert "network of these weights is switched off" in capsys.readouterr().err
    enhance_video(tmp_path / "in.mp4", tmp_path / "other.mp4", Enhancer(stirred()), rendered=True)
    assert "was changed" not in capsys.readouterr().err


def test_it_is_said_where_a_scene_gives_nothing_to_go_by(street, capsys):
    (actor, *_) = street.actors
    put_in = replace(actor, asset=replace(actor.asset, meta={**actor.asset.meta, "inserted": True}), track="put_in")
    for scene in (None, replace(street, actors=(actor, put_in))):
        enhancement("builtin", scene=scene)
    enhancement("builtin", references=References([], street), scene=street)
    assert "nothing will be enhanced" not in capsys.readouterr().err
    enhancement("builtin", scene=street)
    assert "nothing will be enhanced: the scene keeps no photos" in capsys.readouterr().err


def test_outputs_that_are_rendered_to_be_kept_change_no_picture(street, tmp_path):
    save_net(Net(SMALL), tmp_path / "untrained.safetensors", {})
    stages, reads = enhancement(str(tmp_path / "untrained.safetensors"))
    (frame,) = render_clip(street, "front_camera", 0.5, times(street)[:1], outputs=("rgb", *reads))
    referenced = replace(frame, reference=torch.ones_like(frame.rgb), trust=torch.ones_like(frame.rgb[..., 0]))
    kept = replace(referenced, need=torch.zeros_like(referenced.trust))
    without, beside = (next(stages["enhance"](iter([f]))) for f in (referenced, kept))
    assert torch.equal(without.rgb, beside.rgb) and beside.need is kept.need and without.rgb.mean() > frame.rgb.mean() + 0.2


def test_of_a_scenes_actors_those_that_were_put_in_or_edited_are_told(street):
    class Listening:
        told, reads = (), ("instance",)

        def step(self, frame, memory=None):
            self.told = (*self.told, frame.instance)
            return frame.rgb, None

    actor = street.actors[0]
    put_in = replace(actor, asset=replace(actor.asset, meta={**actor.asset.meta, "inserted": True}), track="put_in")
    scene = replace(street, actors=(actor, put_in))
    instance = torch.tensor([[-1, 0, 1, 2]], dtype=torch.int32)
    frame = Frame(street.camera("front_camera", times(street)[0]), rgb=torch.rand(1, 4, 3), instance=instance)
    listening = Listening()
    (after,) = enhance_frames([frame], listening, scene)
    assert listening.told[0].tolist() == [[-1, 0, 0, 2]] and after.instance is instance
    list(enhance_frames([frame], listening))
    assert listening.told[1] is instance
    assert telling(replace(frame, instance=None), [1]).instance is None
