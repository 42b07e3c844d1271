"""The folder in which DiffusionRenderer is met; its scripts are stood in for by files of the names that they give."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from enhance.commands import Pairs
from enhance.pairs.clips import PairConfig
from enhance.pairs.diffusion_renderer import FRAMES, Relit
from enhance.pairs.make import make_pairs
from enhance.pairs.shards import PairSet
from enhance.pairs.sources import prepare_sources
from scenes.opening import UsageError

CONFIG = PairConfig(width=96, frames=3, every=4)


def run_scripts(folder: Path, lights: int) -> None:
    """As both do with --save_image True: all frames of 1280x704, clips filled up to FRAMES with their last; here in other colours."""
    for clip in (folder / "photos").iterdir():
        files = sorted(clip.glob("*.png"))
        files += [files[-1]] * (5 - len(files))  # FRAMES would take long
        for light in range(lights):
            for i, file in enumerate(files):
                out = folder / "relit" / f"relit_frames_{light:04d}" / clip.name / f"0000.{i:04d}.jpg"
                out.parent.mkdir(parents=True, exist_ok=True)
                pixels = np.array(Image.open(file).resize((1280, 704))) // (2 + light)
                Image.fromarray(pixels).save(out, quality=85)


def test_photos_go_out_and_come_back_under_another_light(street, recording, tmp_path):
    folder = tmp_path / "relit"
    sources = prepare_sources(street, recording, tmp_path / "pairs", ["relight"], relit=folder)

    def make(out: str, seed: int = 0) -> PairSet:
        return PairSet(make_pairs(street, recording, tmp_path / out, ["relight"], sources=sources, config=CONFIG, seed=seed))

    with pytest.raises(ValueError, match="lacks 4 of 4 clips under other skies; their photos are in its photos/ now") as said:
        make("pairs")
    commands = re.sub(r"\\\n", "", str(said.value))
    assert f"--dataset_path {folder}/photos --video_save_folder {folder}\n" in commands and f"--num_video_frames {FRAMES}" in commands
    assert f"--dataset_path {folder}/gbuffer_frames --video_save_folder {folder}/relit" in commands
    clips = sorted(p.name for p in (folder / "photos").iterdir())
    assert clips == ["front_camera_0000", "front_camera_0004", "left_camera_0000", "left_camera_0004"]
    sent = np.array(Image.open(folder / "photos" / clips[1] / "0002.png"))
    np.testing.assert_array_equal(sent, recording.camera("front_camera").image(6))

    run_scripts(folder, lights=2)
    lit = {seed: {shard.path.stem: shard for shard in make(f"pairs{seed}", seed).shards} for seed in (0, 1)}
    assert {s.meta["light"] for seed in lit for s in lit[seed].values()} == {"relit_frames_0000", "relit_frames_0001"}
    changed = 0
    for shard in lit[0].values():
        dimmed = 2 + int(shard.meta["light"][-1])
        w = shard.window(0, 3)
        inside, outside = (w.region > 0.99).expand_as(w.input), (w.region == 0).expand_as(w.input)
        assert torch.equal(w.input[outside], w.target[outside])
        if inside.any():
            changed += 1
            assert (w.input[inside] - w.target[inside] / dimmed).abs().mean() < 0.02
    assert changed >= 2
    again = make("pairs_again").shards[0]
    assert torch.equal(again.window(0, 3).input, lit[0][again.path.stem].window(0, 3).input)


def test_a_clip_counts_as_lit_when_all_its_frames_are_there(street, recording, tmp_path):
    relit = Relit(tmp_path)
    relit.ask(recording.camera("front_camera"), "front_camera_0000", range(3))
    run_scripts(tmp_path, lights=2)
    assert relit.lights("front_camera_0000", 3) == ["relit_frames_0000", "relit_frames_0001"]
    frame = tmp_path / "relit/relit_frames_0000/front_camera_0000/0000.0002.jpg"
    frame.write_bytes(b"no picture")
    with pytest.raises(ValueError, match="0000.0002.jpg does not decode as an image"):
        relit.read("relit_frames_0000", "front_camera_0000", 3, (96, 54))
    frame.unlink()
    assert relit.lights("front_camera_0000", 3) == ["relit_frames_0001"] and relit.lights("front_camera_0000", 2)[0][-1] == "0"


def test_a_folder_for_other_kinds_is_refused(tmp_path):
    with pytest.raises(UsageError, match="--relit is for the kind relight"):
        Pairs((tmp_path / "s",), tmp_path / "pairs", data=(tmp_path / "d",), kinds=("clean",), relit=tmp_path / "relit").run()
