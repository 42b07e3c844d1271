"""A made-up recording of the street, before any format: a turning body, cameras, a spinning lidar, a mover and a parked car.

The writers of the public layouts (made_kitti.py, ...) put it on disk as their data sets would; `check` holds a reader to it.
"""

from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree
from street import START_US, STEP_US

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep, Track
from render import render_frame
from scenes import Trajectory
from scenes.camera import Camera
from scenes.lenses import Pinhole
from scenes.poses import inverse, translation, yaw

FRAMES = 6
SIZE = (96, 54)
PARKED = np.array([4.0, 1.8, 1.5])
MOVER = np.array([4.2, 1.8, 1.5])
STAMPS = START_US + STEP_US * np.arange(FRAMES)
BODY_FROM_LIDAR = translation(0.9, 0.1, 1.8) @ yaw(0.02)
LOST = 2
"""The sweep that is missing."""


@dataclass(frozen=True)
class Tape:
    """ego: the body; cameras: `body_from_cam` by name; points: `[N, 3]` static, in the world."""

    street: object
    ego: Trajectory
    cameras: dict[str, torch.Tensor]
    points: np.ndarray

    def camera(self, name: str, time_us: int) -> Camera:
        lens = self.street.rig["front_camera"].lens
        return Camera(lens, *SIZE, self.ego.near(time_us) @ self.cameras[name], time_us=time_us)

    def image(self, name: str, time_us: int) -> np.ndarray:
        with torch.no_grad():
            rgb = render_frame(self.street, self.camera(name, time_us)).rgb
        return (rgb.clamp(0, 1) * 255).round().byte().numpy()

    def mover(self, time_us: int) -> torch.Tensor:
        """`world_from_box` of the oncoming car."""
        return self.street.actors[0].trajectory.near(time_us)

    def parked(self) -> torch.Tensor:
        return translation(14.0, -4.0, 0.0) @ yaw(0.3)

    def scan(self, stamp: int, turn_us: int = 0) -> np.ndarray:
        """The static points in the lidar's frame; taken in a turn of `turn_us` that looks ahead at `stamp`, or all at once."""
        return self._scanned(stamp, turn_us)[0]

    def _scanned(self, stamp: int, turn_us: int) -> tuple[np.ndarray, np.ndarray]:
        """As `scan`, and when each was taken."""
        times = np.full(len(self.points), stamp)
        for _ in range(4):  # when a point was taken depends on where the lidar was then
            poses = np.stack([inverse(self.ego.near(int(t)) @ BODY_FROM_LIDAR).numpy() for t in times])
            local = np.einsum("nij,nj->ni", poses[:, :3, :3], self.points) + poses[:, :3, 3]
            times = stamp + np.round(np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi) * turn_us).astype(np.int64)
        return local, times

    def log(self, late: dict[str, int], turn_us: int = 0, lost: int | None = LOST, encoded: str = "PNG") -> Log:
        """The recording as a log, in its own world: pictures so many microseconds after the sweeps, which take `turn_us`."""
        lens = self.street.rig["front_camera"].lens
        cameras = {}
        for name, delay in late.items():
            times = torch.from_numpy(STAMPS + delay)
            files = tuple(Packed(f"{name}.{encoded.lower()}", partial(self._encoded, name, t, encoded)) for t in times.tolist())
            cameras[name] = LogCamera(name, lens, *SIZE, files, times, self.ego.near_each(times) @ self.cameras[name])
        sweeps = []
        for i, t in enumerate(STAMPS.tolist()):
            if i != lost:
                points = LidarPoints(self.points, self._scanned(t, turn_us)[1], np.zeros(len(self.points), np.int64))
                sweeps.append(Sweep(i, t, partial(replace, points)))
        boxes = (("mover", True, MOVER, [self.mover(t) for t in STAMPS.tolist()]), ("parked", False, PARKED, [self.parked()] * FRAMES))
        tracks = tuple(
            Track(f"veh_{i}", "car", moving, size, STAMPS, torch.stack(poses), np.full(FRAMES, -1), (name,))
            for i, (name, moving, size, poses) in enumerate(boxes, 1)
        )
        return Log("tape", Path("tape"), cameras, tuple(sweeps), tracks, self.ego, {}, lidars={0: BODY_FROM_LIDAR[:3, 3].numpy()})

    def _encoded(self, name: str, time_us: int, encoded: str) -> bytes:
        packed = BytesIO()
        Image.fromarray(self.image(name, time_us)).save(packed, encoded, quality=95)
        return packed.getvalue()


def tape(street) -> Tape:
    """5 m/s, turning left by a degree a frame; a front camera and one half a metre to its right."""
    times = START_US + STEP_US * (torch.arange(FRAMES + 2) - 1)
    ego = Trajectory(times, torch.stack([translation(0.5 * i, 0.004 * i * i, 0.0) @ yaw(0.017 * i) for i in range(-1, FRAMES + 1)]))
    front = street.rig["front_camera"].body_from_cam
    points = street.background.gaussians.means.double().numpy()
    points = points[np.abs(points[:, 1]) > 2.0]  # where the car drives, it is itself what a lidar sees
    points = points[np.random.default_rng(0).choice(len(points), 150, replace=False)]
    lens = Pinhole(58.0, 56.0, 47.0, 28.5)  # of four numbers that cannot be told for one another
    still = replace(street, ego=ego, rig={"front_camera": replace(street.rig["front_camera"], lens=lens)})
    return Tape(still, ego, {"front": front, "right": front @ translation(0.5, 0.0, 0.0)}, points)


def check(log: Log, tape: Tape, names: dict[str, str], atol: float = 1e-6, lidar: float = 0.02) -> None:
    """The log says what the tape does, in a world of its own.

    names: the log's camera by the tape's; atol, lidar: metres that poses and points may be off.
    """
    lead = log.camera(names["front"])
    home, away = inverse(lead.world_from_cam[0]), inverse(tape.camera("front", int(lead.times_us[0])).world_from_cam)
    for theirs, ours in names.items():
        camera = log.camera(ours)
        assert len(camera) == FRAMES and (camera.width, camera.height) == SIZE
        np.testing.assert_allclose(camera.lens.params()[:4], tape.street.rig["front_camera"].lens.params(), atol=1e-5)
        assert not camera.lens.params()[4:].any()
        for i, t in enumerate(camera.times_us.tolist()):
            truth = tape.camera(theirs, t)
            torch.testing.assert_close(home @ camera.world_from_cam[i], away @ truth.world_from_cam, atol=atol, rtol=0)
        assert np.abs(camera.image(2).astype(int) - tape.image(theirs, int(camera.times_us[2]))).mean() < 3
    # ahead is x, left is y, up is z: the recording drives straight on and turns left
    first, last = log.ego.at(int(STAMPS[0])), log.ego.at(int(STAMPS[-1]))
    went = inverse(first) @ last
    assert went[0, 3] > 2.4 and abs(float(went[1, 3])) < 0.4 and 0.05 < float(torch.atan2(went[1, 0], went[0, 0])) < 0.12
    assert first[2, 2] > 0.999 and first[:3, 3].norm() < 3
    if log.sweeps:
        assert len(log.sweeps) == FRAMES - 1  # the writers lose one
        assert log.lidars.keys() & set(log.sweeps[0].read().sensor.tolist())
        for place in log.lidars.values():
            np.testing.assert_allclose(place, BODY_FROM_LIDAR[:3, 3], atol=1e-5)
        for sweep in (log.sweeps[0], log.sweeps[-1]):
            got = sweep.read()
            ours = got.xyz @ home[:3, :3].numpy().T + home[:3, 3].numpy()
            truth = tape.points @ away[:3, :3].numpy().T + away[:3, 3].numpy()
            assert len(ours) == len(truth) and max(cKDTree(a).query(b)[0].max() for a, b in ((ours, truth), (truth, ours))) < lidar
            assert np.abs(got.times_us - sweep.time_us).max() <= STEP_US
    if log.tracks:
        assert {(t.moving, t.label) for t in log.tracks} == {(True, "car"), (False, "car")}
        assert [t.name for t in log.tracks] == ["veh_1", "veh_2"]
        moving = next(t for t in log.tracks if t.moving)
        parked = next(t for t in log.tracks if not t.moving)
        np.testing.assert_allclose(moving.size, MOVER, atol=1e-5)
        np.testing.assert_allclose(parked.size, PARKED, atol=1e-5)
        for t, pose in zip(moving.times_us.tolist(), moving.world_from_box, strict=True):
            torch.testing.assert_close(home @ pose, away @ tape.mover(t), atol=max(atol, 1e-4), rtol=0)
        torch.testing.assert_close(home @ parked.world_from_box[2], away @ tape.parked(), atol=max(atol, 1e-4), rtol=0)
        stamps = {s.time_us for s in log.sweeps}
        assert not stamps or stamps & set(moving.times_us.tolist())
