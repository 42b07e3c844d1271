"""What to tell of actors that an edit brings to where nobody knows the ground, where something else is, or whose unseen sides it shows."""

from __future__ import annotations

from dataclasses import replace

from scenes.collide import collisions
from scenes.edit import Edit
from scenes.scene import Scene
from scenes.seen import seeing, unseen_warning
from scenes.standing import outside_ground
from scenes.trajectory import Trajectory


def astray(edit: Edit, scene: Scene) -> list[str]:
    """A sentence for each actor that an edit shifts beyond the scene's ground, further than it was."""
    said = []
    for actor in (a for a in scene.actors if a.track in edit.shift):
        was, now = _beyond(scene, actor.trajectory), _beyond(scene, edit.path(actor, scene))
        if now > was:
            said.append(f"{actor.track} is shifted {now:.3g} m beyond the known ground and keeps the height of its edge there")
    return said


def meeting(edit: Edit, scene: Scene) -> list[str]:
    """A sentence for what each actor that an edit changes runs into, and did not before, and for sides of one that took another's place
    which recorded cameras see and no photo of it shows."""
    changed = {a.track: edit.apply(a, scene) for a in scene.actors if a.track in {*edit.shift, *edit.replace, *edit.retime}}
    left = tuple(changed.get(a.track, a) for a in scene.actors if a.track not in edit.remove)
    after, said = replace(scene, actors=left), []
    for before in (a for a in scene.actors if a.track in changed and a.track not in edit.remove):
        actor, known = changed[before.track], collisions(scene, before)
        said += [f"{actor.track} {line}" for what, line in collisions(after, actor).items() if what not in known]
        if before.track in edit.replace:
            said += unseen_warning(actor, seeing(actor, [scene.camera(n, int(t)) for n in scene.rig for t in scene.frame_times(n)]))
    return said


def _beyond(scene: Scene, path: Trajectory) -> float:
    """Metres by which a path leaves the scene's ground at most."""
    return max(outside_ground(scene, point) for point in path.world_from_body[:, :2, 3])
