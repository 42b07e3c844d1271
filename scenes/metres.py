"""Whether a scene's unit is the metre: a world that pictures alone made has none until somebody gives it one."""

from __future__ import annotations

from scenes.scene import Scene

FIX = "--camera-height 1.5m (of the cameras above the road) or --metres-per-unit"


def is_metric(scene: Scene) -> bool:
    """Whether lengths in the scene are metres; scenes that say nothing are."""
    return bool(scene.meta.get("metric", True))


def require_metres(scene: Scene, what: str) -> None:
    """ValueError with the fix where `what` asks for metres of a scene that has none."""
    if not is_metric(scene):
        name = scene.meta.get("path", scene.meta.get("name", "the scene"))
        why = f"{what} is in metres, but {name} has no metric scale: its poses come from pictures alone"
        raise ValueError(f"{why}; reconstruct it again with {FIX}")
