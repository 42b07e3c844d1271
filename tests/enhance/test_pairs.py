"""Pairs of a made-up street: its "recording" is rendered from it."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_colmap import pictures_along, write_colmap
from made_drive import write_drive
from PIL import Image
from street import car

from enhance.pairs import inputs
from enhance.pairs.claims import claim_pairs
from enhance.pairs.clips import Clip, PairConfig, of_scene
from enhance.pairs.damage import ORDER
from enhance.pairs.degrade import Underfit, unfinish
from enhance.pairs.inputs import held_out_camera, open_reconstruction, open_recording
from enhance.pairs.lighting import random_sky
from enhance.pairs.make import make_pairs
from enhance.pairs.refits import REFITS, Refit, as_reconstructed, shots_of
from enhance.pairs.shards import KINDS, PairSet
from enhance.pairs.sources import Sources, kinds_for, prepare_sources
from recon import open_log
from recon.assets.extract import FEWEST_SPLATS, Candidate
from recon.log import LogCamera
from render import render_frame
from render.compare import psnr
from render.references import References
from render.video import write_image
from scenes import load, save
from scenes.databank import Databank
from scenes.edit import Edit
from scenes.trajectory import Trajectory
from scenes.usd.edit import add_change

CONFIG = PairConfig(width=96, frames=3, every=4)


@pytest.fixture(scope="module")
def sources(street, recording):
    """Spoilt splats stand in for fits from less, which have tests of their own."""
    shots = shots_of(recording, street)
    spoilt = Refit(References(shots, unfinish(street, Underfit(thin=0.5, colour=0.2), 0)), ("front_camera", "left_camera"))
    own = {a.track: a.asset for a in street.actors}
    refits = {kind: [spoilt] for kind in REFITS}
    return Sources(shots=shots, refits=refits, skies=[random_sky(np.random.default_rng(3))], own=own, assets=[car()])


@pytest.fixture(scope="module")
def folder(street, recording, sources, tmp_path_factory):
    return make_pairs(street, recording, tmp_path_factory.mktemp("made") / "pairs", KINDS, seed=1, sources=sources, config=CONFIG)


def test_every_clip_of_every_camera_has_every_kind_and_a_sheet(folder):
    pairs = PairSet(folder)
    assert len(pairs.shards) == len(KINDS) * 2 * 2
    assert {s.meta["camera"] for s in pairs.of(split="held out")} == {"front_camera"}
    assert {s.meta["camera"] for s in pairs.of(split="train")} == {"left_camera"}
    assert all((folder / f"{kind}.png").stat().st_size > 1000 for kind in KINDS)


def test_a_scene_of_a_part_of_a_drive_makes_pairs_of_that_part(street, recording, tmp_path):
    """Cameras may begin before its first one, too."""
    part = slice(2, 7)
    rig = {name: replace(c, times_us=c.times_us[part]) for name, c in street.rig.items()}
    scene = replace(
        street, rig=rig, ego=replace(street.ego, times_us=street.ego.times_us[part], world_from_body=street.ego.world_from_body[part])
    )
    made = PairSet(make_pairs(scene, recording, tmp_path / "pairs", ("clean",), config=PairConfig(width=96, frames=3, every=2)))
    for name, camera in scene.rig.items():
        shown = {t for shard in made.of() if shard.meta["camera"] == name for t in shard.meta["times_us"]}
        assert shown == set(camera.times_us.tolist())
    assert prepare_sources(scene, recording, tmp_path, ("reinsert",)).shots, "at poses that the scene knows"


def test_of_sixty_pictures_a_second_no_more_are_the_scenes_than_it_has(street, recording):
    left = recording.camera("left_camera")
    times = left.times_us[0] + 16_667 * torch.arange(len(left))
    log = replace(recording, cameras={"left_camera": replace(left, times_us=times)})
    scene = replace(street, rig={"left_camera": replace(street.rig["left_camera"], times_us=times[2:5] + 3000)})
    assert torch.equal(of_scene(log, scene).camera("left_camera").times_us, times[2:5])


def test_damage_falls_inside_the_region_only(folder):
    for shard in PairSet(folder).shards:
        w = shard.window()
        changed = (w.input != w.target).any(1, keepdim=True)
        assert not (changed & (w.region == 0)).any()
        assert shard.meta["kind"] == "clean" or w.region.max() == 0 or changed.any()


def test_every_kind_damages_some_clip_and_says_so(folder):
    for kind in set(KINDS) - {"clean"}:
        assert any(s.window().region.max() == 1 for s in PairSet(folder).of(kind)), kind


def test_kinds_keep_their_seeds(folder):
    assert ORDER == KINDS == ("underfit", "isp", "clean", "sparse", "cycle", "crossref", "relight", "shadow", "reinsert", "isp_frame")


def test_a_shadow_only_darkens_and_lies_beside_what_was_put_in(folder, street):
    shards = [s for s in PairSet(folder).of("shadow") if s.window().region.max() > 0]
    assert shards
    for shard in shards:
        w = shard.window()
        assert (w.target <= w.input).all() and shard.meta["instances"] == [len(street.actors) + 1]
        assert (w.instance == len(street.actors) + 1).any() and (w.region[w.instance != len(street.actors) + 1] > 0.5).any()


def test_what_is_put_back_leaves_the_photo_as_the_target(folder):
    photos = {s.path.stem: s.window().target for s in PairSet(folder).of("clean")}
    shards = [s for s in PairSet(folder).of("reinsert") if s.window().region.max() > 0]
    assert shards
    for shard in shards:
        w = shard.window()
        assert torch.equal(w.target, photos[shard.path.stem]) and shard.meta["tracks"] == ["veh_1"]
        assert (w.region[torch.isin(w.instance, torch.tensor(shard.meta["instances"], dtype=torch.int16))] > 0.6).all()


def test_what_photos_say_of_what_is_put_back_lies_where_it_is_and_is_nearer_to_the_target(folder):
    shards = [s for s in PairSet(folder).of("reinsert") if s.window().region.max() > 0]
    for shard in shards:
        w = shard.window()
        assert shard.referenced and not w.trust[w.region == 0].any() and w.trust.max() > 0.3
    assert not any(s.referenced for s in PairSet(folder).of("isp"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_pairs_made_on_a_gpu_are_alike(street, recording, sources, folder, tmp_path):
    refits = {
        kind: [replace(r, references=References(sources.shots, r.references.recorded.to("cuda"))) for r in made]
        for kind, made in sources.refits.items()
    }
    there = replace(sources, refits=refits)
    out = make_pairs(street, recording, tmp_path / "pairs", KINDS, seed=1, sources=there, config=CONFIG, device="cuda")
    pairs = PairSet(folder).shards, PairSet(out).shards
    for here, other in zip(*pairs, strict=True):
        a, b = here.window(), other.window()
        assert here.path.relative_to(folder) == other.path.relative_to(out) and here.meta == other.meta
        for name in ("input", "target", "region", "reference", "trust"):
            assert (getattr(a, name) - getattr(b, name)).abs().mean() < 0.01, (here.path, name)
        assert (a.instance != b.instance).float().mean() < 0.01


def test_depth_is_kept_beside_the_frames(folder):
    from safetensors import safe_open

    for shard in PairSet(folder).shards:
        with safe_open(shard.path, "pt") as file:
            depth = file.get_tensor("depth").float()
        assert depth.shape == (shard.frames, shard.height, shard.width) and (depth > 0).all()
        assert torch.isinf(depth).any() and torch.isfinite(depth).any()


def test_a_kind_without_what_it_is_made_from_says_what_it_needs(street, recording, tmp_path):
    for kind, needs in (("sparse", "refits"), ("shadow", "assets")):
        with pytest.raises(ValueError, match=needs):
            make_pairs(street, recording, tmp_path / kind, kinds=(kind,), config=CONFIG)
    with pytest.raises(ValueError, match="Did you mean sparse"):
        prepare_sources(street, recording, tmp_path, ("spars",))


def test_shadows_without_an_asset_are_refused_before_anything_is_reconstructed(street, recording, tmp_path):
    bare = replace(street, actors=(), meta={**street.meta, "parked": []})
    with pytest.raises(ValueError, match="none to cut out; give --databank"):
        prepare_sources(bare, recording, tmp_path / "p", ("sparse", "shadow"))
    assert not (tmp_path / "p").exists()


def test_clips_that_show_nothing_to_change_are_said(street, recording, tmp_path, capsys):
    empty = replace(street, actors=())
    make_pairs(empty, recording, tmp_path, kinds=("isp", "clean"), config=CONFIG)
    count = len(PairSet(tmp_path).of("isp"))
    assert f"isp: {count} of {count} clips show nothing to change" in (said := capsys.readouterr().err) and "clean:" not in said


def test_without_being_told_kinds_are_those_that_can_be_made(street, recording, tmp_path):
    alone = replace(street, rig={"front_camera": street.rig["front_camera"]}, actors=())
    fine = car().gaussians.select(torch.arange(FEWEST_SPLATS) % len(car().gaussians))
    moved = replace(car(), gaussians=fine, meta={"moved": True})
    found = [Candidate(moved, "veh_1", "", Trajectory(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None]), 1)]
    assert kinds_for(street, recording, found) == KINDS
    assert set(KINDS) - set(kinds_for(alone, recording, [])) == {"crossref", "shadow", "reinsert"}
    Databank(tmp_path / "bank").add(car())
    assert set(KINDS) - set(kinds_for(alone, recording, [], tmp_path / "bank")) == {"crossref", "reinsert"}


def test_the_front_camera_is_held_out_whatever_it_is_called_where_there_are_others(street, recording):
    cameras, rig = dict(recording.cameras), street.rig
    renamed = replace(recording, cameras={"CAM_FRONT": cameras["front_camera"], "CAM_LEFT": cameras["left_camera"]}, front=("CAM_FRONT",))
    both = replace(street, rig={"CAM_LEFT": rig["left_camera"], "CAM_FRONT": rig["front_camera"]})
    assert held_out_camera(both, renamed) == "CAM_FRONT" and held_out_camera(street, recording) == "front_camera"
    assert held_out_camera(replace(both, rig={"CAM_FRONT": rig["front_camera"]}), renamed) is None


def test_photos_whose_rows_were_read_one_by_one_lie_where_renders_do(street, recording, tmp_path):
    """Of them clips and references are made; the scene's cameras take all rows at once."""
    name, readout = "left_camera", 60_000
    rig = replace(street.rig[name], shutter="rows", readout_us=readout)
    scene = replace(street, rig={name: street.rig[name]})
    times = scene.frame_times(name)[2:5]
    files = [tmp_path / f"{i}.png" for i in range(3)]
    for file, t in zip(files, times.tolist(), strict=True):
        write_image(file, render_frame(scene, rig.along(scene.ego, t - readout // 2)).rgb)
    poses = torch.stack([scene.camera(name, int(t)).world_from_cam for t in times])
    camera = LogCamera(name, rig.lens, rig.width, rig.height, tuple(files), times, poses, "rows", readout)
    log = replace(recording, cameras={name: camera})
    clip = Clip(scene, camera, 0, PairConfig(width=rig.width, frames=3), 0, {})
    shots = shots_of(as_reconstructed(log, scene), scene)
    for i, t in enumerate(times.tolist()):
        instant, read = render_frame(scene, scene.camera(name, t)).rgb, torch.from_numpy(camera.image(i).copy()).float() / 255
        shot = torch.from_numpy(shots[i].read(rig.width, rig.height)).float() / 255
        assert psnr(clip.photo(i), instant) > psnr(read, instant) + 3 and psnr(shot, instant) > psnr(read, instant) + 3


def test_the_recording_car_is_no_target(street, recording, tmp_path):
    ego = np.zeros((18, 32), bool)
    ego[14:] = True
    cameras = {name: replace(c, ego_mask=ego, files=tuple(_white(f, tmp_path) for f in c.files)) for name, c in recording.cameras.items()}
    shard = PairSet(make_pairs(street, replace(recording, cameras=cameras), tmp_path / "pairs", ["clean"], config=CONFIG)).shards[0]
    target = shard.frame("target", 0)[0]
    with torch.no_grad():
        wanted = render_frame(street, street.camera(shard.meta["camera"], shard.meta["times_us"][0]).resized(96, 54)).rgb
    assert (target[43:].float() / 255 - wanted[43:].clamp(0, 1)).abs().max() < 0.01
    assert (target[:40].float() / 255 - wanted[:40].clamp(0, 1)).abs().mean() < 0.02


def _white(file, folder):
    """The picture with its lower part white."""
    with Image.open(file) as picture:
        pixels = np.array(picture)
    pixels[len(pixels) * 14 // 18 :] = 255
    Image.fromarray(pixels).save(folder / file.name)
    return folder / file.name


def test_kinds_may_be_added_to_a_folder(street, recording, tmp_path):
    out = make_pairs(street, recording, tmp_path / "pairs", kinds=("clean",), cameras=["left_camera"], config=CONFIG)
    make_pairs(street, recording, out, kinds=("isp",), cameras=["left_camera"], config=CONFIG)
    assert {s.meta["kind"] for s in PairSet(out).shards} == {"clean", "isp", "isp_frame"}


def test_a_whole_frame_in_other_colours_is_told_as_such(folder):
    shards = PairSet(folder).of("isp_frame")
    assert any(s.meta["isp"]["noise"] for s in shards) or any(s.meta["isp"]["sharpen"] for s in shards)
    for shard in shards:
        w = shard.window()
        assert (w.region == 1).all() and (w.instance == 1).all() and not torch.equal(w.input, w.target)


def test_a_folder_of_scenes_is_one_set(folder, tmp_path):
    (tmp_path / "one").symlink_to(folder)
    assert len(PairSet(tmp_path).shards) == len(PairSet(folder).shards)


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


def test_the_same_seed_makes_the_same_pairs_and_another_others(street, recording, sources, folder, tmp_path):
    how = {"kinds": ("underfit",), "cameras": ["left_camera"], "sources": sources, "config": CONFIG}
    one = make_pairs(street, recording, tmp_path / "one", seed=1, **how)
    two = make_pairs(street, recording, tmp_path / "two", seed=2, **how)
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


def test_what_is_no_clip_is_passed_over_and_a_clip_named_twice_counts_once(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "clean")  # a folder called as a kind: its note lies where a clip's description would
    (tmp_path / "clean" / "clean" / ".half.json").write_text("{")
    assert len(PairSet(tmp_path / "clean", tmp_path).shards) == len(PairSet(folder).shards)
    assert len(PairSet(tmp_path, tmp_path / "clean").shards) == len(PairSet(folder).shards)


def test_a_scene_of_pictures_alone_is_met_by_its_recording_in_its_own_metres(street, tmp_path, capsys):
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")
    workspace = write_colmap(tmp_path / "walk", street, {"": pictures_along(street, count=6)})
    log = open_log(workspace, metres_per_unit=7.0)
    scene = replace(street, meta=log.meta)
    found = open_recording(workspace, scene)
    assert torch.equal(found.camera("camera").world_from_cam, log.camera("camera").world_from_cam)
    assert np.array_equal(found.points.xyz, log.points.xyz) and not capsys.readouterr().err
    other = write_colmap(tmp_path / "other", street, {"": pictures_along(street, count=6, step=0.7)[1:]})
    with pytest.raises(ValueError, match="other is not the recording that the scene walk was made from: it is elsewhere; give each"):
        open_recording(other, scene)
    workspace.rename(tmp_path / "renamed")
    open_recording(tmp_path / "renamed", scene)
    assert "renamed is called renamed, and its scene walk: if it is another drive" in capsys.readouterr().err


def test_a_scene_of_a_part_of_a_video_is_met_by_that_part(street, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(inputs, "open_log", lambda path, **given: asked.append(given) or SimpleNamespace(meta=meta, name="walk.mp4"))
    meta = {"name": "walk.mp4", "world_from_model": {"scale": 2.0}, "part_us": [60_000_000, 15_000_000]}
    open_recording(tmp_path / "walk.mp4", replace(street, meta=meta))
    assert asked == [{"metres_per_unit": 2.0, "part_us": (60_000_000, 15_000_000)}]


def test_another_drives_recording_is_refused_by_where_it_is(street, tmp_path):
    own_drive = write_drive(tmp_path / "drive", street)
    log = open_log(own_drive)
    open_recording(own_drive, replace(street, meta=log.meta))
    away = {**log.meta, "world_origin": [v + 400 for v in log.meta["world_origin"]]}
    with pytest.raises(ValueError, match="is not the recording that the scene"):
        open_recording(own_drive, replace(street, meta=away))


def test_pairs_are_of_what_was_recorded_whatever_was_edited_since(street, tmp_path):
    save(street, tmp_path / "s")
    add_change(tmp_path / "s", "edit", street, Edit(remove=(street.actors[0].track,)), {"kind": "edit"})
    assert not load(tmp_path / "s").actors and len(open_reconstruction(tmp_path / "s").actors) == len(street.actors)
    with pytest.raises(ValueError, match="is not a scene; pairs are made from a scene"):
        open_reconstruction(tmp_path / "s" / "background.usdc")


def test_a_clip_that_is_there_is_not_made_again_of_other_things(street, recording, tmp_path):
    claim_pairs(tmp_path, street, recording, 0, CONFIG, {"skies of relight": "[]"})
    (tmp_path / "relight").mkdir()
    (tmp_path / "relight" / "front_camera_0000.json").write_text("{}")
    claim_pairs(tmp_path, street, recording, 0, CONFIG, {"skies of shadow": "['a.hdr']"})
    with pytest.raises(ValueError, match="holds pairs of another skies of relight"):
        claim_pairs(tmp_path, street, recording, 0, CONFIG, {"skies of relight": "['a.hdr']"})


def test_what_a_first_run_was_made_of_is_kept(street, recording, tmp_path):
    made_of = {"skies of relight": "['a.hdr']"}
    claim_pairs(tmp_path, street, recording, 0, CONFIG, made_of)
    make_pairs(street, recording, tmp_path, kinds=("relight",), config=CONFIG, made_of=made_of)
    with pytest.raises(ValueError, match="holds pairs of another skies of relight"):
        claim_pairs(tmp_path, street, recording, 0, CONFIG, {"skies of relight": "[]"})


def test_a_run_that_made_nothing_leaves_its_folder_free(street, recording, tmp_path):
    """As one that was refused for a sky or a databank that is broken: the mended command must not be refused for that."""
    claim_pairs(tmp_path, street, recording, 0, CONFIG, {"skies of shadow": "['broken.hdr']"})
    (tmp_path / "shadow").mkdir()
    claim_pairs(tmp_path, street, recording, 1, CONFIG, {"skies of shadow": "['a.hdr']"})
    make_pairs(street, recording, tmp_path, kinds=("clean",), seed=1, config=CONFIG)
    claim_pairs(tmp_path, street, recording, 1, CONFIG, {"skies of shadow": "[]"})  # there are no shadows yet
    with pytest.raises(ValueError, match="other settings"):
        claim_pairs(tmp_path, street, recording, 0, CONFIG)
    for fits in ("early", "refits"):
        (tmp_path / fits / fits / "sparse_scene").mkdir(parents=True)
        claim_pairs(tmp_path / fits, street, recording, 0, CONFIG)
        with pytest.raises(ValueError, match="other settings"):
            claim_pairs(tmp_path / fits, street, recording, 1, CONFIG)


def test_a_broken_sky_or_asset_is_refused_before_anything_is_reconstructed(street, recording, tmp_path):
    (tmp_path / "a.hdr").write_bytes(b"no sky")
    with pytest.raises(ValueError, match="a.hdr"):
        prepare_sources(street, recording, tmp_path / "p", ("sparse", "shadow"), skies=[tmp_path / "a.hdr"])
    with pytest.raises(FileNotFoundError, match="is not a databank"):
        prepare_sources(street, recording, tmp_path / "p", ("sparse", "shadow"), databank=tmp_path)
    assert not (tmp_path / "p").exists()


def test_pairs_in_a_folder_that_takes_no_files_are_refused_before_anything_is_made(tmp_path, street, recording, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)  # root may write anywhere
    with pytest.raises(PermissionError, match="cannot write .*/new/pairs: .* is not writable; give a folder of your own"):
        claim_pairs(tmp_path / "new" / "pairs", street, recording, 0, CONFIG)
