"""The root layer of a scene folder: nothing but the order in which its layers count, so that every edit outweighs what was recorded.

In USD a layer's own opinions are stronger than those of its sublayers. So scene.usda has none: its sublayers are the edits, the
newest first, and last recorded.usda, which holds the scene as it was reconstructed.
"""

from __future__ import annotations

from pathlib import Path

from pxr import Sdf

from scenes.atomic import atomic_file

RECORDED = "./recorded.usda"


def write_root(scene: Path) -> None:
    """Write scene.usda over a folder's recorded.usda, without edits."""
    _write(scene, Sdf.Layer.OpenAsAnonymous(str(scene / RECORDED)), [RECORDED])


def add_sublayer(scene: Path, sub: str) -> None:
    """Make `sub` the strongest layer of a scene. A scene of before, whose root held the recording, gets a root of its own first."""
    layer = Sdf.Layer.OpenAsAnonymous(str(scene / "scene.usda"))
    paths = list(layer.subLayerPaths)
    if RECORDED not in paths:
        layer.subLayerPaths = []
        with atomic_file(scene / RECORDED) as partial:
            _export(layer, partial)
        paths.append(RECORDED)
    _write(scene, layer, [sub, *(p for p in paths if p != sub)])


def drop_sublayer(scene: Path, sub: str) -> None:
    """Take `sub` out of a scene's layers; nothing where it is none of them."""
    layer = Sdf.Layer.OpenAsAnonymous(str(scene / "scene.usda"))
    if sub in list(layer.subLayerPaths):
        layer.subLayerPaths = [p for p in layer.subLayerPaths if p != sub]
        with atomic_file(scene / "scene.usda") as partial:
            _export(layer, partial)


def _write(scene: Path, like: Sdf.Layer, paths: list[str]) -> None:
    """scene.usda with these sublayers and the stage's metadata (time codes, up, metres) of another layer."""
    root = Sdf.Layer.CreateAnonymous(".usda")
    for key in like.pseudoRoot.ListInfoKeys():
        if key not in ("subLayers", "subLayerOffsets", "primChildren"):
            root.pseudoRoot.SetInfo(key, like.pseudoRoot.GetInfo(key))
    root.subLayerPaths = paths
    with atomic_file(scene / "scene.usda") as partial:
        _export(root, partial)


def _export(layer: Sdf.Layer, path: Path) -> None:
    if not layer.Export(str(path)):
        raise OSError(f"cannot write {path}")
