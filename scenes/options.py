"""How values are written on the command line: with units, as lists, as places. Loads nothing heavy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg

from scenes import units
from scenes.axes import AXES
from scenes.lateral import Keyframe, parse_lateral
from scenes.opening import scene_folder
from scenes.placement import Placement, parse_at, parse_path, parse_placement


def written(parse: Callable[[str], Any], metavar: str, default: str, choices: tuple[str, ...] | None = None) -> Any:
    """How tyro reads a value that is written with a unit or in a form of ours; `default` is what --help shows for its default. choices: all
    that there are, which may begin with a dash."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: [default],
        choices=choices,
    )


LARGEST = 16_384
"""Pixels along a side: H.264 holds no more."""


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ValueError(f'"{text}" is not a size; write width and height in pixels, as 640x360')
    if max(int(width), int(height)) > LARGEST:
        raise ValueError(f'"{text}" is larger than a video can be; give at most {LARGEST} pixels a side, as 3840x2160')
    return int(width), int(height)


def _rate(text: str) -> float:
    rate = units.number(text)
    if not 0 < rate < 1000:
        raise ValueError(f'"{text}" is not a frame rate; write frames a second, above 0 and below 1000, as 10')
    return rate


def _ratio(text: str) -> float:
    ratio = units.number(text)
    if not 0 < ratio < float("inf"):
        raise ValueError(f'"{text}" is not a ratio; write a positive number, as 0.5')
    return ratio


def _effort(text: str) -> float:
    effort = units.number(text)
    if not 0.1 <= effort <= 100:
        raise ValueError(f'"{text}" is not an effort; write a number from 0.1 to 100, where 1 is the default, as 2')
    return effort


def _of_track(text: str, parse: Callable[[str], Any], example: str) -> tuple[str, Any]:
    track, equals, value = text.partition("=")
    if not (track and equals and value):
        raise ValueError(f'"{text}" is not of the form ACTOR=VALUE; write it as {example}')
    return track, parse(value)


def _label(text: str) -> str:
    if not text.strip():
        raise ValueError("the label is empty; write car, cone, or a name of your own")
    return text


def names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


Lateral = Annotated[float | tuple[Keyframe, ...], written(parse_lateral, "LENGTH[@TIME,...]", "0m")]
LengthOrNone = Annotated[float | None, written(units.length, "LENGTH", "none")]
Ratio = Annotated[float | None, written(_ratio, "NUMBER", "none")]
Effort = Annotated[float, written(_effort, "NUMBER", "1")]
AngleOrNone = Annotated[float | None, written(units.angle, "ANGLE", "none")]
Angle = Annotated[float, written(units.angle, "ANGLE", "0deg")]
Speed = Annotated[float, written(units.speed, "SPEED", "0m/s")]
Time = Annotated[int, written(units.duration_us, "TIME", "0s")]
TimeOrAll = Annotated[int | None, written(units.duration_us, "TIME", "the rest")]
Size = Annotated[tuple[int, int] | None, written(_size, "WxH", "as recorded")]
FitSize = Annotated[tuple[int, int] | None, written(_size, "WxH", "as recorded, at most as many pixels as 960x540")]
Names = Annotated[tuple[str, ...] | None, written(names, "NAME,NAME", "all")]
FrontNames = Annotated[tuple[str, ...] | None, written(names, "NAME,NAME", "those that look ahead")]
Rate = Annotated[float | None, written(_rate, "FPS", "as recorded")]
Place = Annotated[tuple[float, float] | None, written(parse_at, "X,Y", "none")]
Way = Annotated[str, written(parse_path, "straight|lane", "straight")]
FileOrNone = Annotated[Path | None, written(Path, "FILE", "none")]
FolderOrNone = Annotated[Path | None, written(Path, "FOLDER", "none")]
OneOfRig = Annotated[str | None, written(str, "NAME|FILE", "first")]
Axis = Annotated[str | None, written(str, "AXIS", "usual", AXES)]
WeightsOrNone = Annotated[str | None, written(str, "builtin|FILE", "none")]
Insertion = Annotated[Placement, written(parse_placement, "ID@X,Y[,yaw=A][,speed=V][,path=lane]", "none")]
Shift = Annotated[
    tuple[str, tuple[float, float]], written(lambda text: _of_track(text, parse_at, "veh_3=0m,1.5m"), "ACTOR=FORWARD,LEFT", "none")
]
Replacement = Annotated[tuple[str, str], written(lambda text: _of_track(text, str, "veh_4=car/0003"), "ACTOR=ID", "none")]
Retiming = Annotated[tuple[str, int], written(lambda text: _of_track(text, units.duration_us, "veh_5=+0.5s"), "ACTOR=TIME", "none")]
Track = Annotated[str, written(str, "NAME", "none")]
Label = Annotated[str, written(_label, "NAME", "none")]
Name = Annotated[str | None, written(str, "NAME", "edit, edit_2, ...")]
Output = Annotated[Path, arg(aliases=("-o",))]
Overwrite = FlagCreatePairsOff[Annotated[bool, arg(aliases=("-w",))]]
Flag = FlagCreatePairsOff[bool]
ScenePath = Positional[Annotated[Path, written(scene_folder, "SCENE", "none")]]
AnyPath = Positional[Annotated[Path, arg(metavar="PATH")]]
