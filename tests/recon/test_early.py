"""Scenes of a fit that is stopped early."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from quick_fit import CONFIG, SIZE

from recon import open_log, stopped_early
from recon.fit.fit import Fit
from render import render_frame
from render.compare import psnr
from scenes import load


def test_a_fit_stopped_early_gives_scenes_that_get_better(drive, tmp_path, monkeypatch):
    log = open_log(drive)
    short = replace(CONFIG, steps=80)
    paths = stopped_early(log, tmp_path / "early", shares=(0.5, 0.1, 1.0), size=SIZE, config=short)
    assert [p.name for p in paths] == ["10", "50", "100"]
    scenes = [load(p) for p in paths]
    assert len({len(s.background.gaussians) for s in scenes}) > 1 and scenes[0].meta["name"].endswith("at 10 percent")
    view, photo = log.cameras["front_camera"], []
    for scene in scenes:
        camera = scene.camera("front_camera", int(view.times_us[4])).resized(*SIZE)
        photo.append(psnr(render_frame(scene, camera).rgb, torch.from_numpy(np.array(view.image(4, *SIZE))) / 255))
    assert photo[0] < photo[2]
    monkeypatch.setattr(Fit, "step", None)  # nothing is fitted again
    assert stopped_early(log, tmp_path / "early", shares=(0.1, 0.5, 1.0), size=SIZE, config=short) == paths
    with pytest.raises(ValueError, match="shares"):
        stopped_early(log, tmp_path / "early", shares=(0.0,))
