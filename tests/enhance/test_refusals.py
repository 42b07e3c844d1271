"""What training and pairs refuse before they begin, and what they leave as it was."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from small_net import stirred

from enhance.commands import Pairs, Train
from enhance.enhancer import Enhancer
from enhance.evaluate import main
from enhance.network.weights_file import REPAIR_GAIN, load_net, save_net
from enhance.pairs.clips import PairConfig
from enhance.pairs.make import make_pairs
from enhance.pairs.of_photos import make_photo_pairs
from enhance.pairs.shards import PairSet, to_bytes, write_shard
from enhance.step import checked
from enhance.training.run import TrainConfig, opened
from enhance.training.train import train
from recon.build import reconstruct
from render.frame_types import Frame
from render.video import write_image
from scenes import save
from scenes.camera import Camera
from scenes.lenses import Pinhole
from scenes.opening import UsageError

QUICK = TrainConfig(crop=32, images=2, clips=1, frames=2, looked_at=2)


def written(folder, *kinds) -> PairSet:
    """A training clip of noise of each kind."""
    rgb = to_bytes(torch.rand(3, 40, 56, 3, generator=torch.Generator().manual_seed(1)))
    region = torch.zeros(3, 40, 56, dtype=torch.uint8)
    region[:, 10:30, 10:40] = 255
    flow, seen = torch.zeros(3, 40, 56, 2, dtype=torch.float16), torch.ones(3, 40, 56, dtype=torch.uint8)
    depth = torch.ones(3, 40, 56, dtype=torch.float16)
    pictures = {"input": rgb, "target": rgb.clone(), "region": region, "instance": region // 255}
    tensors = {**pictures, "flow": flow, "visible": seen, "depth": depth}
    for kind in kinds:
        write_shard(folder / kind / "a.safetensors", tensors, {"kind": kind, "split": "train", "instances": [1], "seed": 0})
    return PairSet(folder)


@pytest.fixture(scope="module")
def awake(tmp_path_factory):
    """Weights whose network was found worth running."""
    path = tmp_path_factory.mktemp("weights") / "awake.safetensors"
    save_net(stirred(), path, {REPAIR_GAIN: [1.5, 2.0]})
    return path


@pytest.mark.parametrize(
    ("kind", "only", "takes"),
    [("isp", "enhancer", "sparse, cycle, crossref"), ("clean", "shade", "shadow pairs"), ("shadow", "objects", "isp or clean pairs")],
)
def test_a_stage_without_anything_to_train_on_is_refused_before_it_begins(awake, tmp_path, kind, only, takes):
    with pytest.raises(ValueError, match=f"nothing to train {only} on.*{takes}"):
        train(written(tmp_path / "p", kind), tmp_path / "t", steps=4, config=QUICK, start=awake, only=[only])
    assert not (tmp_path / "t").exists()


def test_stages_that_nobody_named_are_left_out_and_said(awake, tmp_path, capsys):
    weights = train(written(tmp_path / "p", "isp"), tmp_path / "t", steps=4, config=QUICK, start=awake)
    assert load_net(weights)[1]["steps"] == {"autoencoder": 0, "prior": 0, "objects": 4, "shade": 0, "enhancer": 0}
    said = capsys.readouterr().err
    assert "shadow pairs: left out" in said and "crossref: left out" in said


def test_what_repairs_keeps_its_measured_gain_where_it_was_not_trained(awake, tmp_path):
    weights = train(written(tmp_path / "p", "isp", "underfit"), tmp_path / "t", steps=3, config=QUICK, start=awake, only=["objects"] * 2)
    about = load_net(weights)[1]
    assert about[REPAIR_GAIN] == [1.5, 2.0] and about["steps"]["objects"] == 3


def test_a_gain_is_not_measured_anew_where_nothing_is_held_out(awake, tmp_path):
    pairs = written(tmp_path / "p", "isp", "underfit")
    for stage in ("prior", "enhancer"):
        weights = train(pairs, tmp_path / stage, steps=3, config=QUICK, start=awake, only=[stage])
        assert load_net(weights)[1][REPAIR_GAIN] == [1.5, 2.0]
    save_net(stirred(), tmp_path / "of_before.safetensors", {})
    weights = train(pairs, tmp_path / "old", steps=3, config=QUICK, start=tmp_path / "of_before.safetensors", only=["objects"])
    assert REPAIR_GAIN not in load_net(weights)[1]


def test_where_no_stage_has_anything_to_train_on_none_is_written(awake, tmp_path):
    with pytest.raises(ValueError, match="nothing to train any of objects, shade, enhancer on"):
        train(written(tmp_path / "p", "relight"), tmp_path / "t", steps=4, config=QUICK, start=awake)
    assert not (tmp_path / "t").exists()


def test_a_training_goes_on_with_its_own_settings_and_with_no_others(awake, tmp_path):
    pairs, how = written(tmp_path / "p", "isp"), {"start": awake, "only": ["objects"]}
    train(pairs, tmp_path / "t", steps=3, config=QUICK, **how)
    with pytest.raises(ValueError, match="begun with the rate 0.0008, not 0.01"):
        train(pairs, tmp_path / "t", steps=4, config=replace(QUICK, rate=1e-2), resume=True, **how)
    assert load_net(train(pairs, tmp_path / "t", steps=4, resume=True, **how))[1]["steps"]["objects"] == 4
    assert opened(tmp_path / "t" / "checkpoint.pt")["config"]["crop"] == QUICK.crop


def test_weights_trained_anew_are_other_weights_to_start_from(awake, tmp_path):
    start, how = tmp_path / "start.safetensors", {"config": QUICK, "only": ["objects"]}
    shutil.copy(awake, start)
    pairs = written(tmp_path / "p", "isp")
    train(pairs, tmp_path / "t", steps=3, start=start, **how)
    save_net(stirred(seed=1), start, {})
    with pytest.raises(ValueError, match="begun with the start start.safetensors"):
        train(pairs, tmp_path / "t", steps=4, start=start, resume=True, **how)


@pytest.mark.parametrize("change", ["stages", "start", "pairs"])
def test_a_resumed_training_of_something_else_is_refused(awake, tmp_path, change):
    first, other = written(tmp_path / "p", "isp"), written(tmp_path / "q", "isp", "clean")
    how = {"steps": 4, "config": QUICK, "start": awake, "only": ["objects"]}
    train(first, tmp_path / "t", **how)
    before = (tmp_path / "t" / "checkpoint.pt").read_bytes()
    again = {"stages": {**how, "only": ["prior"]}, "start": {**how, "start": "builtin"}, "pairs": how}[change]
    if change == "start":
        shutil.copy(awake, tmp_path / "twin.safetensors")
        again = {**how, "start": tmp_path / "twin.safetensors"}
    with pytest.raises(ValueError, match=f"begun with the {change}.*resume with the same command"):
        train(other if change == "pairs" else first, tmp_path / "t", resume=True, **again)
    assert (tmp_path / "t" / "checkpoint.pt").read_bytes() == before


@pytest.mark.parametrize("spoil", ["cut", "foreign", "other size"])
def test_a_damaged_clip_is_named_with_the_fix(tmp_path, spoil, capsys):
    written(tmp_path / "p", "isp")
    clip = tmp_path / "p" / "isp" / "a.safetensors"
    if spoil == "other size":
        about = json.loads(clip.with_suffix(".json").read_text())
        clip.with_suffix(".json").write_text(json.dumps({**about, "height": 39}))
    else:
        clip.write_bytes(clip.read_bytes()[:900] if spoil == "cut" else b"no tensors")
    with pytest.raises(ValueError, match=r"a.safetensors .*delete a.json"):
        PairSet(tmp_path / "p").shards[0].window()
    assert main([str(tmp_path / "p"), "--split", "train"]) == 1 and "delete a.json" in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["0", "-1", "x"])
def test_a_table_of_no_clips_is_refused(limit, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), f"--limit={limit}"])
    assert f"must be a whole number from 1, got {limit}" in capsys.readouterr().err


def test_a_rollout_that_is_not_there_is_said_before_anything_is_measured(tmp_path, monkeypatch, capsys):
    written(tmp_path / "p", "clean")
    monkeypatch.setitem(main.__globals__, "evaluate", lambda *_: pytest.fail("it measures"))
    assert main([str(tmp_path / "p"), "--split", "train", "--rollout", str(tmp_path / "gone.mp4")]) == 1
    assert "gone.mp4" in capsys.readouterr().err


def test_pairs_of_another_scene_do_not_go_into_the_same_folder(street, recording, tmp_path):
    config = PairConfig(width=32, frames=2, every=4)
    out = make_pairs(street, recording, tmp_path / "p", ("clean",), config=config)
    with pytest.raises(ValueError, match="pairs of another scene"):
        make_pairs(replace(street, actors=()), recording, out, ("clean",), config=config)
    note = out / "pairs.json"
    settings = json.loads(note.read_text())
    note.write_text("")
    with pytest.raises(ValueError, match=r"pairs.json does not say how these pairs were made"):
        make_pairs(street, recording, out, ("clean",), config=config)
    note.write_text(json.dumps({k: v for k, v in settings.items() if k not in ("scene", "recording")}))  # as the code before wrote it
    make_pairs(street, recording, out, ("clean",), config=config)


def test_photos_of_one_name_and_other_settings_are_refused(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place / "img").mkdir(parents=True)
        write_image(tmp_path / place / "img" / "0.png", torch.rand(40, 56, 3))
    with pytest.raises(ValueError, match="called img"):
        make_photo_pairs([tmp_path / "a" / "img", tmp_path / "b" / "img"], tmp_path / "p", width=32)
    make_photo_pairs([tmp_path / "a" / "img"], tmp_path / "p", width=32)
    with pytest.raises(ValueError, match="other settings"):
        make_photo_pairs([tmp_path / "a" / "img"], tmp_path / "p", width=32, seed=1)
    kept = {p: p.read_bytes() for p in (tmp_path / "p").rglob("*.safetensors")}
    with pytest.raises(ValueError, match="another source img"):  # by another command
        make_photo_pairs([tmp_path / "b" / "img"], tmp_path / "p", width=32)
    assert kept == {p: p.read_bytes() for p in (tmp_path / "p").rglob("*.safetensors")}


def test_what_is_wrongly_named_is_found_before_anything_is_reconstructed(street, recording, tmp_path, monkeypatch):
    monkeypatch.setattr("enhance.pairs.inputs.open_recording", lambda *_: recording)
    monkeypatch.setattr("enhance.pairs.sources.prepare_sources", lambda *_: pytest.fail("it reconstructs"))
    save(street, tmp_path / "street")
    (tmp_path / "other").mkdir()
    one = Pairs((tmp_path / "street",), tmp_path / "out", (tmp_path,), cameras=("lefd_camera",))
    with pytest.raises(ValueError, match="Did you mean left_camera"):
        one.run()
    with pytest.raises(ValueError, match="other is neither a scene"):  # before the first scene's pairs, which may take hours
        replace(one, cameras=None, scenes=(*one.scenes, tmp_path / "other"), data=(tmp_path, tmp_path)).run()
    with pytest.raises(ValueError, match="called img"):
        replace(one, cameras=None, photos=(tmp_path / "a" / "img", tmp_path / "b" / "img")).run()
    with pytest.raises(UsageError, match="--cameras is empty"):
        replace(one, cameras=()).run()
    with pytest.raises(FileNotFoundError, match="gone.hdr does not exist"):
        replace(one, cameras=None, skies=(tmp_path / "gone.hdr",)).run()
    with pytest.raises(UsageError, match="--seed must be a whole number from 0"):
        replace(one, cameras=None, seed=-1).run()
    with pytest.raises(UsageError, match="--only needs weights to fine-tune; give --start"):
        Train((tmp_path,), tmp_path / "t", only=("objects",)).run()
    for size in (0, -5, 31):
        with pytest.raises(ValueError, match=f"at least 32 pixels wide, got {size}"):
            replace(one, cameras=None, size=size).run()
        with pytest.raises(ValueError, match=f"at least 32 pixels wide, got {size}"):
            make_photo_pairs([tmp_path], tmp_path / "out", width=size)
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match="--only is empty"):
        Train((tmp_path,), tmp_path / "t", only=()).run()
    make_pairs(replace(street, actors=()), recording, tmp_path / "out", ("clean",), config=PairConfig(frames=2, width=32))
    with pytest.raises(ValueError, match="other settings"):
        replace(one, cameras=None).run()


def test_what_photos_say_must_be_finite_and_is_trusted_in_all_at_most():
    rgb, trust = torch.rand(4, 6, 3), torch.full((4, 6), 2.0)
    camera = Camera(Pinhole(5.0, 5.0, 3.0, 2.0), 6, 4, torch.eye(4, dtype=torch.float64))
    given = checked(Frame(camera, rgb=rgb, reference=rgb, trust=trust, need=torch.full((4, 6), torch.nan)))
    assert (given.reference[1] == 1).all() and (given.need == 1).all()
    bad = rgb.clone()
    bad[2, 3, 1] = torch.nan
    with pytest.raises(ValueError, match="reference holds a value that is not finite at row 2, column 3"):
        checked(Frame(camera, rgb=rgb, reference=bad, trust=trust))
    with pytest.raises(ValueError, match="trust holds"):
        checked(Frame(camera, rgb=rgb, reference=rgb, trust=torch.full((4, 6), torch.inf)))


def test_a_vgg_that_is_none_is_refused_before_anything_is_trained(awake, tmp_path):
    (tmp_path / "vgg16.pth").write_bytes(b"P" + bytes(200))
    with pytest.raises(ValueError, match=r"vgg16.pth does not open as tensors alone"):
        train(written(tmp_path / "p", "isp"), tmp_path / "t", steps=4, config=QUICK, start=awake, vgg=tmp_path / "vgg16.pth")
    assert not (tmp_path / "t").exists()


def test_weights_are_never_trained_over(tmp_path):
    pairs, out = written(tmp_path / "p", "clean"), tmp_path / "t"
    out.mkdir()
    (out / "enhancer.safetensors").write_bytes(b"someone's weights")
    for resume in (False, True):
        with pytest.raises(FileExistsError, match=r"enhancer.safetensors exists already.*choose another folder"):
            train(pairs, out, steps=4, config=QUICK, resume=resume)
    assert [p.read_bytes() for p in out.iterdir()] == [b"someone's weights"]


@pytest.mark.parametrize("device", ["gpu", "CPU", "meta", "", None])
def test_a_device_that_does_not_exist_is_refused_in_words(device):
    with pytest.raises(ValueError, match='device must be "cpu" or "cuda"'):
        Enhancer.load("builtin", device=device)


def test_a_gpu_beyond_those_that_are_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ValueError, match="this machine has 1 CUDA device, from cuda:0; got cuda:7"):
        Enhancer.load("builtin", device="cuda:7")


def test_a_gpu_that_is_not_there_is_refused_before_anything_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for device in ("cuda", "cuda:0", torch.device("cuda")):
        with pytest.raises(ValueError, match="no CUDA device that torch can use"):
            Enhancer.load("nowhere", device=device)
    with pytest.raises(ValueError, match="no CUDA device that torch can use"):
        reconstruct(None, tmp_path / "scene", device="cuda")


def test_clips_of_two_drives_by_the_same_names_are_told_apart(street, recording, tmp_path):
    config = PairConfig(width=96, frames=3, every=4)
    folder = make_pairs(street, recording, tmp_path / "one", kinds=("clean",), config=config)
    shutil.copytree(folder, tmp_path / "other")
    assert PairSet(folder).digest() == PairSet(tmp_path / "other").digest()
    for file in (tmp_path / "other" / "clean").glob("*.json"):
        meta = json.loads(file.read_text())
        file.write_text(json.dumps({**meta, "times_us": [t + 60_000_000 for t in meta["times_us"]]}))
    assert PairSet(folder).digest() != PairSet(tmp_path / "other").digest()
