import pytest
import torch

from recon.log import Log, LogCamera
from render import render_frame
from render.video import write_image


@pytest.fixture(scope="session")
def recording(street, tmp_path_factory):
    """The made-up street as it would be recorded, without lidar; not to be changed."""
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
