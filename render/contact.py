"""A contact sheet: pictures side by side under their names, one row a moment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from render.video import to_bytes
from scenes.atomic import atomic_file

GAP, BAND = 6, 26
PAPER, INK = (24, 24, 26), (235, 235, 235)


def write_contact_sheet(path: Path, columns: Sequence[str], rows: Sequence[tuple[str, Sequence[torch.Tensor | None]]]) -> None:
    """Write a PNG with a named column for each of `columns`; a row is its own name and one picture `[H, W, 3]` a column.

    All pictures have the size of the first; a None leaves its place empty. The file appears whole or not at all.
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = next(p for _, pictures in rows for p in pictures if p is not None).shape[:2]
    size = (GAP + len(columns) * (width + GAP), BAND + len(rows) * (height + BAND))
    sheet = Image.new("RGB", size, PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for c, name in enumerate(columns):
        draw.text((GAP + c * (width + GAP) + 4, 5), name, fill=INK, font=font)
    for r, (name, pictures) in enumerate(rows):
        top = BAND + r * (height + BAND)
        for c, picture in enumerate(pictures):
            if picture is not None:
                sheet.paste(Image.fromarray(to_bytes(picture)), (GAP + c * (width + GAP), top))
        draw.text((GAP + 4, top + height + 5), name, fill=INK, font=font)
    with atomic_file(path) as partial:
        sheet.save(partial)
