"""Pairs of a made-up street: its "recording" is rendered from it."""

import json

import pytest
import torch

from enhance.pairs import PairConfig, make_pairs
from enhance.shards import PairSet
from recon.log import Log, LogCamera
from render import render_frame
from render.video import write_image

CONFIG = PairConfig(width=96, frames=3, every=4)


@pytest.fixture(scope="module")
def recording(street, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    cameras = {}
    for name, rig in street.rig.items():
        views = [street.camera(name, int(t)) for t in rig.times_us]
        files = tuple(folder / f"{name}_{i}.png" for i in range(len(views)))
        for file, view in zip(files, views, strict=True):
            write_image(file, render_frame(street, view).rgb)
        poses = torch.stack([v.world_from_cam for v in views])
        cameras[name] = LogCamera(name, rig.lens, rig.width, rig.height, files, rig.times_us, poses)
    return Log("street", folder, cameras, (), (), street.ego, {})


@pytest.fixture(scope="module")
def folder(street, recording, tmp_path_factory):
    return make_pairs(street, recording, tmp_path_factory.mktemp("made") / "pairs", seed=1, config=CONFIG)


def test_every_clip_of_every_camera_has_every_kind_and_a_sheet(folder):
    pairs = PairSet(folder)
    assert len(pairs.shards) == 3 * 2 * 2
    assert {s.meta["camera"] for s in pairs.of(split="held out")} == {"front_camera"}
    assert {s.meta["camera"] for s in pairs.of(split="train")} == {"left_camera"}
    assert all((folder / f"{kind}.png").stat().st_size > 1000 for kind in ("underfit", "isp", "clean"))


def test_damage_falls_inside_the_region_only(folder):
    for shard in PairSet(folder).shards:
        w = shard.window()
        changed = (w.input != w.target).any(1, keepdim=True)
        assert not (changed & (w.region == 0)).any()
        assert shard.meta["kind"] == "clean" or w.region.max() == 0 or changed.any()


def test_colour_changes_stay_on_instances(folder):
    shards = [s for s in PairSet(folder).of("isp") if s.meta["instances"]]
    assert shards
    for shard in shards:
        w = shard.window()
        inside = torch.isin(w.instance, torch.tensor(shard.meta["instances"], dtype=w.instance.dtype))
        assert inside[w.region == 1].all()


def test_flow_moves_the_previous_target_onto_this_one(folder):
    from render.warp import warp

    w = PairSet(folder).of("clean", "held out")[0].window()
    moved, inside = warp(w.target[:2], w.flow[1:])
    seen = (w.visible[1:] * inside) > 0
    assert seen.float().mean() > 0.5 and torch.isnan(w.flow[0]).all() and w.visible[0].max() == 0
    still = (w.target[1:] - w.target[:2]).abs()[seen.expand(-1, 3, -1, -1)].mean()
    assert (w.target[1:] - moved).abs()[seen.expand(-1, 3, -1, -1)].mean() < still


def test_the_same_seed_makes_the_same_pairs_and_another_others(street, recording, folder, tmp_path):
    one = make_pairs(street, recording, tmp_path / "one", kinds=("underfit",), cameras=["left_camera"], seed=1, config=CONFIG)
    two = make_pairs(street, recording, tmp_path / "two", kinds=("underfit",), cameras=["left_camera"], seed=2, config=CONFIG)
    name = "underfit/left_camera_0004.safetensors"
    assert (one / name).read_bytes() == (folder / name).read_bytes() != (two / name).read_bytes()


def test_a_broken_off_run_goes_on_where_it_stopped(street, recording, tmp_path):
    def stop(done, of, name):
        if done == 1:
            raise KeyboardInterrupt

    out = tmp_path / "pairs"
    with pytest.raises(KeyboardInterrupt):
        make_pairs(street, recording, out, kinds=("clean",), config=CONFIG, progress=stop)
    first = next((out / "clean").glob("*.safetensors"))
    before = first.stat().st_mtime_ns
    make_pairs(street, recording, out, kinds=("clean",), config=CONFIG)
    assert first.stat().st_mtime_ns == before and len(PairSet(out).shards) == 4


def test_a_folder_made_with_other_settings_is_refused(street, recording, folder):
    with pytest.raises(ValueError, match="other settings"):
        make_pairs(street, recording, folder, seed=2, config=CONFIG)


@pytest.mark.parametrize(
    ("wrong", "says"), [({"kinds": ("clear",)}, "Did you mean clean"), ({"cameras": ["lefd_camera"]}, "Did you mean left_camera")]
)
def test_unknown_names_offer_the_nearest(street, recording, tmp_path, wrong, says):
    with pytest.raises(ValueError, match=says):
        make_pairs(street, recording, tmp_path / "pairs", config=CONFIG, **wrong)


def test_damaged_pair_folders_say_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="sidestep pairs"):
        PairSet(tmp_path / "none")
    with pytest.raises(ValueError, match="no pairs"):
        PairSet(tmp_path)
    (tmp_path / "isp").mkdir()
    (tmp_path / "isp" / "a.json").write_text("{")
    with pytest.raises(ValueError, match="a.json"):
        PairSet(tmp_path)
    (tmp_path / "isp" / "a.json").write_text(json.dumps({"frames": 1, "height": 2, "width": 2, "kind": "isp", "split": "train"}))
    with pytest.raises(FileNotFoundError, match="a.safetensors"):
        PairSet(tmp_path)
