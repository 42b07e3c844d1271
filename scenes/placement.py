"""Where an asset goes, as people write it: "car/0003@12m,3.5m,yaw=5deg,speed=8m/s". Pure Python: the front door needs it at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from scenes.names import nearest
from scenes.units import angle, length, number, speed

KEYS = ("yaw", "speed", "path", "trajectory")
PATHS = ("straight", "lane")
COLUMNS = ("time_s", "x_m", "y_m", "yaw_deg")

FARTHEST = 100_000.0
"""Metres from the body at the clip's first frame: no drive goes farther, and coordinates of a map mostly do."""

FASTEST = 150.0
"""Metres a second: nothing on a road is faster."""


@dataclass(frozen=True)
class Placement:
    """An asset of the databank and its place, relative to the unshifted body at the clip's first frame.

    x, y: metres forward and left of the body; yaw: radians to the left of its heading; speed: metres a second along the
    asset's own heading; path: "straight" on, or in a "lane" beside the recorded path, to which yaw then is relative; trajectory: a CSV
    file of the same frame (see `read_waypoints`), in place of all these. ValueError for a place beyond `FARTHEST` and a speed beyond
    `FASTEST`.
    """

    asset: str
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    speed: float = 0.0
    path: str = "straight"
    trajectory: Path | None = None

    def __post_init__(self):
        if not math.hypot(self.x, self.y) <= FARTHEST:
            told = f"{self.asset} at {self.x:g}m,{self.y:g}m is more than {FARTHEST / 1000:g} km from the car at the clip's first frame"
            raise ValueError(f"{told}; a place counts metres from there, not coordinates of a map")
        if not abs(self.speed) <= FASTEST:
            told = f"{self.asset} at {self.speed:g}m/s is faster than {FASTEST:g}m/s, as nothing on a road is"
            raise ValueError(f"{told}; write km/h as 50km/h")


@dataclass(frozen=True)
class Waypoint:
    """Microseconds after the clip's first frame; metres forward and left of the body there; radians left of its heading, or None."""

    time_us: int
    x: float
    y: float
    yaw: float | None


def parse_at(text: str) -> tuple[float, float]:
    """ "20m,-3.5m" as metres forward and left. ValueError with the fix otherwise."""
    parts = text.split(",")
    if len(parts) != 2:
        raise ValueError(f'"{text}" is not a place; write metres forward and left, as 20m,-3.5m')
    return length(parts[0]), length(parts[1])


def parse_placement(text: str) -> Placement:
    """ "ID@X,Y[,yaw=5deg][,speed=8m/s][,path=lane]" or "ID@trajectory=t.csv". ValueError with the fix otherwise."""
    asset, at, rest = text.partition("@")
    if not at or not asset:
        raise ValueError(f'"{text}" is not an insertion; write ID@X,Y, as car/0003@12m,3.5m (metres forward, left)')
    if rest.startswith("trajectory="):
        return Placement(asset, trajectory=Path(rest.removeprefix("trajectory=")))  # a path may hold any character
    parts = rest.split(",")
    place = [p for p in parts if "=" not in p]
    given: dict[str, str] = {}
    for key, _, value in (p.partition("=") for p in parts if "=" in p):
        if key not in KEYS:
            raise ValueError(f'"{text}" has the unknown key "{key}"; there are {", ".join(KEYS)}.{nearest(key, KEYS)}')
        if key in given:
            raise ValueError(f'"{text}" says {key} twice; say it once')
        given[key] = value
    if "trajectory" in given:
        raise ValueError(f'"{text}" gives a place and a trajectory; leave out the place: {asset}@trajectory={given["trajectory"]}')
    x, y = parse_at(",".join(place))
    turn, fast = angle(given.get("yaw", "0deg")), speed(given.get("speed", "0m/s"))
    return Placement(asset, x, y, turn, fast, parse_path(given.get("path", "straight")))


def parse_path(text: str) -> str:
    """ "straight" or "lane". ValueError with the fix otherwise."""
    if text not in PATHS:
        raise ValueError(f'"{text}" is not a path; it is one of {", ".join(PATHS)}.{nearest(text, PATHS)}')
    return text


def read_waypoints(path: Path) -> list[Waypoint]:
    """A CSV trajectory: a header `time_s,x_m,y_m` or `time_s,x_m,y_m,yaw_deg`, then two or more rows with rising times.

    time_s: seconds after the clip's first frame; x_m, y_m: metres forward and left of the unshifted body there; yaw_deg:
    degrees to the left of its heading; without that column the asset faces where it goes.
    Raises ValueError naming file, line and fix; FileNotFoundError.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text file in UTF-8; save it as that") from error
    rows = [(number, [cell.strip().strip('"') for cell in line.split(",")]) for number, line in enumerate(lines, 1) if line.strip()]
    header = rows[0][1] if rows else []
    if tuple(header) not in (COLUMNS, COLUMNS[:3]):
        raise ValueError(
            f'{path} must begin with the header time_s,x_m,y_m or time_s,x_m,y_m,yaw_deg, got "{",".join(header)}"{_other(header)}'
        )
    points: list[Waypoint] = []
    for line, cells in rows[1:]:
        if len(cells) != len(header):
            count = f"{len(cells)} value{'s' * (len(cells) != 1)}"
            raise ValueError(f"{path}, line {line}: {count} for {len(header)} columns ({','.join(header)})")
        values = []
        for name, cell in zip(header, cells, strict=True):
            values.append(number(cell))
            if not math.isfinite(values[-1]):
                raise ValueError(f'{path}, line {line}: {name} is "{cell}", which is not a finite number')
        point = Waypoint(round(values[0] * 1e6), values[1], values[2], math.radians(values[3]) if len(values) > 3 else None)
        if points and point.time_us <= points[-1].time_us:
            before = f"{points[-1].time_us / 1e6:g}"
            raise ValueError(f"{path}, line {line}: time_s must rise by a microsecond or more, but {cells[0]} follows {before}")
        points.append(point)
    if len(points) < 2:
        fix = "what stands has its place in both"
        raise ValueError(f"{path} has {len(points)} row{'s' * (len(points) != 1)} below its header; a trajectory needs at least 2; {fix}")
    return points


def _other(header: list[str]) -> str:
    """The fix for a header that separates its columns by something else than commas."""
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if tuple(cell.strip() for cell in "".join(header).split(mark)) in (COLUMNS, COLUMNS[:3]):
            return f"; separate the columns by commas, not by {name}, and write decimals with a point"
    return ""
