"""What to tell of actors that an edit shifts to where nobody knows the ground."""

from __future__ import annotations

from scenes.edit import Edit
from scenes.insert import outside_ground
from scenes.scene import Scene
from scenes.trajectory import Trajectory


def astray(edit: Edit, scene: Scene) -> list[str]:
    """A sentence for each actor that an edit shifts beyond the scene's ground, further than it was."""
    said = []
    for actor in (a for a in scene.actors if a.track in edit.shift):
        was, now = _beyond(scene, actor.trajectory), _beyond(scene, edit.apply(actor, scene).trajectory)
        if now > was:
            said.append(f"{actor.track} is shifted {now:.3g} m beyond the known ground and keeps the height of its edge there")
    return said


def _beyond(scene: Scene, path: Trajectory) -> float:
    """Metres by which a path leaves the scene's ground at most."""
    return max(outside_ground(scene, point) for point in path.world_from_body[:, :2, 3])
