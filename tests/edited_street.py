"""The made-up street with more cars, and edits of it."""

from dataclasses import replace

import torch
from street import START_US, STEP_US, box, car, street

from scenes import Actor, Gaussians, Scene, Trajectory
from scenes.edit import HIDDEN, Edit
from scenes.poses import translation
from scenes.usd.edit import add_edit


def busy() -> Scene:
    """The street with three more cars: one goes along x, one stands, and one has left a ghost in the background."""
    times = START_US + STEP_US * torch.arange(9)
    along = Trajectory(times, torch.stack([translation(8 + 0.5 * i, -3.0, 0.0) for i in range(9)]))
    still = Trajectory(times[:1], translation(15.0, 5.0, 0.0)[None])
    scene = street()
    ghost = box((3.0, 1.0, 1.0), (0.9, 0.9, 0.9))
    ghost = replace(ghost, means=ghost.means + torch.tensor([10.0, -3.0, 0.25]))
    background = replace(scene.background, gaussians=Gaussians.cat([scene.background.gaussians, ghost]))
    more = (Actor(car(), along, "veh_2"), Actor(car("van"), still, "veh_3"))
    return replace(scene, actors=(*scene.actors, *more), background=background)


def parking() -> Scene:
    """The street with a car of splats that the background holds, as a log's boxes tell."""
    scene, place = busy(), translation(20.0, -7.0, 0.0)
    splats = car().gaussians
    background = Gaussians.cat([scene.background.gaussians, replace(splats, means=splats.means + place[:3, 3].float())])
    entry = {"track": "veh_7", "label": "car", "size": car().size.tolist(), "world_from_box": place.tolist()}
    return replace(scene, background=replace(scene.background, gaussians=background), meta={**scene.meta, "parked": [entry]})


VAN = car("van", (0.9, 0.9, 0.1))

ALL = Edit(remove=("veh_1",), shift={"veh_2": (1.0, 1.5)}, replace={"veh_3": VAN}, retime={"veh_2": 300_000})


def same(a: Scene, b: Scene) -> None:
    assert [x.track for x in a.actors] == [x.track for x in b.actors]
    for x, y in zip(a.actors, b.actors, strict=True):
        assert torch.equal(x.trajectory.times_us, y.trajectory.times_us)
        torch.testing.assert_close(x.trajectory.world_from_body, y.trajectory.world_from_body, atol=1e-12, rtol=0)
        assert x.asset.label == y.asset.label and torch.equal(x.asset.gaussians.means, y.asset.gaussians.means)
    before, after = (s.background.gaussians.logit_opacities for s in (a, b))
    torch.testing.assert_close(before, after, atol=1e-4, rtol=0)


def put_in(scene, name="new"):
    add_edit(scene, name, [Actor(VAN, Trajectory(torch.tensor([0]), translation(9.0)[None]), name)], {"kind": "insert"})


def shown(scene: Scene) -> torch.Tensor:
    return scene.background.gaussians.logit_opacities > HIDDEN + 1e-3
