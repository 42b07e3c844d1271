"""How far to the left of the recorded path, as people write it: "2m", or "0m@2s,3.5m@5s". Pure Python: the front door needs it at once."""

from __future__ import annotations

from dataclasses import dataclass

from scenes.units import duration_us, length


@dataclass(frozen=True)
class Keyframe:
    """Microseconds after the clip's first frame, and metres to the left of the recorded path there."""

    time_us: int
    left: float


def parse_lateral(text: str) -> float | tuple[Keyframe, ...]:
    """ "2m" as metres to the left all along; "0m@2s,3.5m@5s" as two or more keyframes of a lane change, whose times rise. ValueError with
    the fix otherwise."""
    if "@" not in text and "," not in text:
        return length(text)
    example = "as 0m@2s,3.5m@5s (metres left of the recorded path, seconds after the clip's first frame)"
    keyframes: list[Keyframe] = []
    for part in text.split(","):
        metres, at, time = part.partition("@")
        if not at:
            raise ValueError(f'"{text}" does not say when it is "{part.strip()}"; write it {example}')
        new = Keyframe(duration_us(time), length(metres))
        if keyframes and new.time_us <= keyframes[-1].time_us:
            raise ValueError(f'"{text}" has times that do not rise: {time.strip()} follows {keyframes[-1].time_us / 1e6:g}s')
        keyframes.append(new)
    if len(keyframes) == 1:
        raise ValueError(f'"{text}" says one moment only; say from where to where, {example}, or leave out @{time.strip()}')
    return tuple(keyframes)
