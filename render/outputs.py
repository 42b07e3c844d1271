"""The pictures a render can give, by name. Pure Python: the front door checks names before anything heavy loads."""

from collections.abc import Iterable

from scenes.names import nearest

OUTPUTS = (
    "rgb",
    "alpha",
    "depth",
    "median_depth",
    "normal",
    "features",
    "flow_prev",
    "flow_next",
    "visible_prev",
    "visible_next",
    "instance",
    "instance_alpha",
    "need",
)


def check_outputs(outputs: Iterable[str], known: tuple[str, ...] = OUTPUTS) -> tuple[str, ...]:
    """`outputs` as a tuple of known names; ValueError naming the nearest otherwise."""
    if isinstance(outputs, str):
        raise ValueError(f'outputs must be a tuple of names, got the string "{outputs}"; write ("{outputs}",)')
    outputs = tuple(outputs)
    for name in outputs:
        if name not in known:
            raise ValueError(f'output "{name}" does not exist; there are {", ".join(known)}.{nearest(name, known)}')
    return outputs


def check_scene_outputs(outputs: Iterable[str]) -> tuple[str, ...]:
    """`outputs` as a tuple of names that a scene's frame can have; ValueError otherwise."""
    if not isinstance(outputs, str) and "features" in (outputs := tuple(outputs)):
        raise ValueError('a scene has no "features"; pass them to rasterize with scene.placed(time)')
    return check_outputs(outputs, tuple(name for name in OUTPUTS if name != "features"))
