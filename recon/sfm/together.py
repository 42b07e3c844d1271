"""Which pictures are of one place, told by what pairs of them share: after a cut, or of a title, none of the others' is seen any more."""

from __future__ import annotations

from pathlib import Path


def together(colmap, database: Path) -> list[set[str]]:
    """The names of the pictures in a database, in groups that verified matches link, the largest first. What stays in the picture wherever
    the camera goes, as a logo (COLMAP's watermark), links nothing."""
    kind = colmap.TwoViewGeometryConfiguration
    with colmap.Database.open(database) as opened:
        group = {image.image_id: {image.name} for image in opened.read_all_images()}
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            if not len(geometry.inlier_matches) or geometry.config in (kind.UNDEFINED, kind.DEGENERATE, kind.WATERMARK):
                continue
            first, second = (group[key] for key in colmap.pair_id_to_image_pair(pair))
            if first is not second:
                first |= second
                group.update((key, first) for key, some in group.items() if some is second)
    return sorted({id(some): some for some in group.values()}.values(), key=lambda some: (-len(some), min(some)))
