"""Two furnished rooms and a corridor between them, through which a small robot drives while people walk about."""

from __future__ import annotations

import math

import numpy as np

from render.tracer import Mesh
from tests.bench.worlds.people import walker
from tests.bench.worlds.place import Light, Place, along, clock, looking
from tests.bench.worlds.solids import box, grain, joined, moved, painted, panel, plain, poster

FRAMES, STEP_US, SPEED = 112, 160_000, 0.5
LASTS = 1e-6 * FRAMES * STEP_US
"""Seconds."""

HIGH, THICK = 2.7, 0.15
"""Metres: the ceiling's height and the walls' thickness."""


def room(people: bool, seed: int = 0) -> Place:
    """A robot 0.3 m high looks ahead and to the left; its lidar of 16 beams is 0.45 m above the floor."""
    chance = np.random.default_rng(seed)
    times = clock(FRAMES + 1, STEP_US)
    ways = ((8.2, 1.2), (4.6, 2.1)), ((9.3, -0.4), (9.3, 2.6))
    movers = [walker(f"walker_{i}", way, math.dist(*way) / LASTS, times, 20 + 10 * i) for i, way in enumerate(ways)] if people else []
    return Place(
        "room",
        joined([*_walls(seed), *_furniture(chance)]),
        tuple(movers),
        Light((-0.35, 0.75, 0.56), (0.9, 0.8, 0.62), (0.75, 0.72, 0.66), 1.6),
        along([(0.7, 0.6), (2.5, 0.7), (4.0, 1.3), (5.2, 1.6), (6.8, 1.6), (8.0, 1.3), (11.5, 1.0)], SPEED, times),
        {name: looking((320, 240), 80.0, yaw, (0.1, 0.0, 0.3), times[:-1]) for name, yaw in (("front", 0.0), ("left", 90.0))},
        (tuple(np.linspace(-15.0, 15.0, 16).tolist()), (0.0, 0.0, 0.45)),
        ((0.0, 0.0), (0.2, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.3)),
    )


def _wall(start: tuple[float, float], end: tuple[float, float], texture: np.ndarray, low: float = 0.0, high: float = HIGH) -> Mesh:
    """An upright slab from one place on the floor to another."""
    (x0, y0), (x1, y1) = start, end
    length, yaw = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
    return moved(box((0, 0, 0), (length, THICK, high - low), texture, 2.0), ((x0 + x1) / 2, (y0 + y1) / 2, low), yaw)


def _walls(seed: int) -> list[Mesh]:
    """Rooms from x = 0 to 4.5 and from 6.5 to 13, y = -1.5 to 3.5, a corridor between; doorways at y = 1.0 to 2.2, windows to the left."""
    paint = [grain(seed + i, colour, 0.05) for i, colour in enumerate(((0.82, 0.8, 0.74), (0.66, 0.74, 0.76), (0.8, 0.7, 0.6)))]
    boards, plaster = _boards(seed), grain(seed + 9, (0.9, 0.9, 0.88), 0.03)
    out = [panel((0, -4, 0), (13, 0, 0), (0, 10, 0), boards, 1.2), panel((13, -4, HIGH), (-13, 0, 0), (0, 10, 0), plaster, 2.0)]
    out += [_wall((0, -1.5), (0, 3.5), paint[0]), _wall((13, -1.5), (13, 3.5), paint[2])]
    for x, colour in ((4.5, paint[0]), (6.5, paint[2])):
        out += [_wall((x, -4 if x > 5 else -1.5), (x, 1.0), colour), _wall((x, 2.2), (x, 6 if x > 5 else 3.5), colour)]
        out.append(_wall((x, 1.0), (x, 2.2), colour, 2.1))
    out += [_wall((4.5, -4), (4.5, -1.5), paint[1]), _wall((4.5, 3.5), (4.5, 6), paint[1])]
    out += [_wall((4.5, -4), (6.5, -4), paint[1]), _wall((4.5, 6), (6.5, 6), paint[1])]
    for start, end, colour in ((0.0, 4.5, paint[0]), (6.5, 13.0, paint[2])):
        out.append(_wall((start, -1.5), (end, -1.5), colour))
        middle = (start + end) / 2
        out += [_wall((start, 3.5), (middle - 0.8, 3.5), colour), _wall((middle + 0.8, 3.5), (end, 3.5), colour)]
        out += [
            _wall((middle - 0.8, 3.5), (middle + 0.8, 3.5), colour, 0.0, 0.9),
            _wall((middle - 0.8, 3.5), (middle + 0.8, 3.5), colour, 2.2),
        ]
    outside = grain(seed + 12, (0.35, 0.5, 0.3), 0.3)
    return [
        *out,
        panel((-20, 6.2, -1.0), (60, 0, 0), (0, 40, 0), outside, 6.0),
        box((7, 16, -1), (14, 4, 7), grain(seed + 13, (0.6, 0.5, 0.45)), 4.0),
    ]


def _boards(seed: int, pixels: int = 240) -> np.ndarray:
    """Floor boards, ten a tile."""
    rows = np.arange(pixels) // (pixels // 10)
    tone = np.random.default_rng(seed).uniform(0.75, 1.15, 10)[rows][:, None, None]
    wood = grain(seed + 20, (0.55, 0.4, 0.27), 0.12, pixels)[..., :3] / 255 * tone
    wood[:: pixels // 10] *= 0.5
    return painted(wood)


def _furniture(chance: np.random.Generator) -> list[Mesh]:
    """Table, chairs, shelves, sofa, boxes, a plant, lamps, and posters."""
    wood, dark = grain(31, (0.5, 0.36, 0.22), 0.15, 128), grain(32, (0.2, 0.16, 0.14), 0.15, 128)
    cloth, steel = grain(33, (0.3, 0.35, 0.5), 0.25, 128), plain((0.5, 0.5, 0.52))
    out = [*_table((2.6, 2.4), (1.5, 0.8, 0.74), wood), *_table((9.2, -0.6), (1.2, 0.7, 0.72), dark)]
    for x, y, yaw in ((1.5, 2.4, 0.0), (2.7, 1.65, 1.4), (3.6, 2.6, 3.0), (9.2, 0.1, 4.6), (8.2, -0.7, 0.2)):
        out += [moved(part, (x, y, 0), yaw) for part in _chair(wood)]
    out += [box((3.4, -1.1, 0), (1.8, 0.7, 0.42), cloth, 0.6), box((3.4, -1.38, 0.42), (1.8, 0.16, 0.4), cloth, 0.6)]
    for x, y, yaw in ((0.3, -0.6, 0.0), (12.7, 2.0, math.pi), (12.7, 0.2, math.pi)):
        out += [moved(part, (x, y, 0), yaw) for part in _shelf(chance, dark)]
    for x, y, s in ((1.6, -1.0, 0.35), (10.9, 2.9, 0.5), (10.5, 2.7, 0.3), (5.0, -2.0, 0.6), (6.1, 4.5, 0.5), (7.2, 3.0, 0.4)):
        out.append(box((x, y, 0), (s, s * 0.8, s * 0.7), poster(int(chance.integers(1 << 20)), 64)))
    out += [box((x, y, HIGH - 0.25), (0.4, 0.4, 0.05), plain((0.98, 0.97, 0.9))) for x, y in ((2.2, 1.0), (9.7, 1.0), (5.5, 1.6))]
    out += [
        box((11.6, -0.9, 0), (0.3, 0.3, 0.3), dark),
        box((11.6, -0.9, 0.3), (0.05, 0.05, 0.5), wood),
        box((0.6, 3.0, 0), (0.05, 0.05, 1.5), steel),
    ]
    for x in (1.2, 3.0, 8.0, 11.0):
        out.append(panel((x + 0.4, -1.42, 1.2), (-0.8, 0, 0), (0, 0, 0.9), poster(int(chance.integers(1 << 20)))))
    out += [panel((12.91, 3.0, 1.0), (0, -0.9, 0), (0, 0, 0.7), poster(3)), panel((6.41, -0.9, 1.1), (0, 0.8, 0), (0, 0, 0.8), poster(4))]
    out.append(panel((4.41, -0.4, 1.1), (0, 0.8, 0), (0, 0, 0.8), poster(5)))
    return out


def _table(at: tuple[float, float], size: tuple[float, float, float], wood: np.ndarray) -> list[Mesh]:
    (x, y), (length, width, height) = at, size
    legs = [(x + i * (length / 2 - 0.06), y + j * (width / 2 - 0.06), 0) for i in (-1, 1) for j in (-1, 1)]
    top = box((x, y, height - 0.04), (length, width, 0.04), wood, 0.8)
    under = panel((x - length / 2, y + width / 2, height - 0.04), (length, 0, 0), (0, -width, 0), wood, 0.8)
    return [top, under, *(box(leg, (0.06, 0.06, height - 0.04), wood) for leg in legs)]


def _chair(wood: np.ndarray) -> list[Mesh]:
    seat = [*_table((0, 0), (0.42, 0.42, 0.45), wood)]
    posts = [box((-0.19, y, 0.45), (0.04, 0.04, 0.45), wood) for y in (-0.19, 0.19)]
    return [*seat, *posts, box((-0.19, 0, 0.65), (0.03, 0.38, 0.2), wood)]


def _shelf(chance: np.random.Generator, dark: np.ndarray) -> list[Mesh]:
    """1 m wide and 1.8 m high, open towards x, with books."""
    out = [box((0, y, 0), (0.3, 0.03, 1.8), dark) for y in (-0.5, 0.5)] + [box((-0.14, 0, 0), (0.02, 1.0, 1.8), dark)]
    for z in (0.02, 0.45, 0.9, 1.35, 1.78):
        out.append(box((0, 0, z), (0.3, 1.0, 0.025), dark))
        y = -0.45
        while z < 1.5 and y < 0.4:
            width, height = chance.uniform(0.03, 0.08), chance.uniform(0.2, 0.32)
            if chance.random() < 0.8:
                out.append(box((0.0, y, z + 0.025), (0.2, width * 0.95, height), plain(tuple(chance.uniform(0.1, 0.9, 3)))))
            y += width
    return out
