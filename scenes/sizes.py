"""How large things of a class are: what finds an asset in the wrong unit or on its side. Pure Python."""

from __future__ import annotations

from collections.abc import Sequence

from scenes.names import slug

SIZES: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "car": ((2.5, 6.0), (1.3, 2.6), (1.0, 2.3)),
    "pickup": ((4.0, 7.5), (1.5, 2.8), (1.3, 2.6)),
    "van": ((3.5, 8.0), (1.4, 2.8), (1.5, 3.5)),
    "truck": ((4.0, 25.0), (1.6, 4.0), (1.7, 5.0)),
    "bus": ((5.0, 25.0), (1.8, 3.5), (2.0, 5.0)),
    "motorcycle": ((1.2, 3.0), (0.4, 1.5), (0.7, 2.3)),
    "bicycle": ((1.0, 2.6), (0.3, 1.2), (0.7, 2.3)),
    "pedestrian": ((0.2, 1.8), (0.2, 1.8), (0.8, 2.3)),
    "cone": ((0.1, 0.9), (0.1, 0.9), (0.3, 1.3)),
    "sign": ((0.01, 2.0), (0.01, 2.0), (0.4, 6.0)),
    "tree": ((0.5, 25.0), (0.5, 25.0), (1.0, 40.0)),
}
"""Length, width and height in metres, least and most, of what goes by that name; generous. Other classes are only held to ANYTHING."""

ANYTHING = (0.01, 40.0)

SHEET = 0.02
"""Metres below which a side may be where the other two are as they should: what is flat, as a sign, is in no wrong unit for that."""


LYING = ((1, 2, 0), (0, 2, 1), (2, 1, 0), (2, 0, 1))
"""Which sides of what lies on its side are its length, width and height; first of what has z up and x ahead, read with y up and z ahead."""


def odd_size(label: str, size: Sequence[float], scale: float = 1.0, axes: Sequence[str] = ()) -> str:
    """What is odd about the size `[length, width, height]` in metres of a thing of a class, with the likely cause; '' where nothing is.
    scale: by which the size was multiplied already; axes: those of its file that were taken for up and forward, none where nobody knows."""
    told = " x ".join(f"{v:.3g}" for v in size)
    ranges = SIZES.get(slug(label), (ANYTHING,) * 3)
    if _fits(size, ranges):
        return ""
    low, high = (" x ".join(f"{r[i]:g}" for r in ranges) for i in (0, 1))
    said = f"is {told} m long, wide and high, but a {label} has {low} to {high} m"
    for factor, unit in ((0.001, "millimetres"), (0.01, "centimetres"), (0.0254, "inches"), (1000.0, "kilometres")):
        if _fits([v * factor for v in size], ranges):
            cause = f"it seems to be in {unit}" if scale == 1 else "the scale is not the file's"
            return f"{said}: {cause}; give --scale {factor * scale:g}"
    across, *lying = (_fits([size[i] for i in order], ranges) for order in ((1, 0, 2), *LYING))
    if across or any(lying):
        seems = ["stand across"] * across + ["lie on its side"] * any(lying)
        fixes = ["--forward"] * across + ["--up"] * any(lying)
        usual = ", as --up z --forward x, which CAD and robots use" if lying[0] and [axis[-1] for axis in axes] == ["y", "z"] else ""
        return f"{said}: it seems to {', or to '.join(seems)}; give another {' or '.join(fixes)}{usual}"
    middle = [(r[0] * r[1]) ** 0.5 for r in ranges]
    return f"{said}; if it is one, give --scale {scale * max(middle) / max(max(size), 1e-9):.2g} or so"


def _fits(size: Sequence[float], ranges: Sequence[tuple[float, float]]) -> bool:
    out = [(v, low) for v, (low, high) in zip(size, ranges, strict=True) if not low <= v <= high]
    return not out or (len(out) == 1 and out[0][0] < out[0][1] <= SHEET)
