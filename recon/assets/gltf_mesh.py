"""A glTF mesh as trimesh reads it, but for what has no material: that gets the format's default one, white and opaque.

Without one trimesh takes vertex colours of 16 bits for bytes, and has a colour of its own for those that lack them.
"""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path

from scenes.formats.gltf import CHUNK, HEADER

SUFFIXES = (".glb", ".gltf")


def load_gltf(path: Path):
    """trimesh's scene of a .glb or .gltf file. Raises whatever trimesh, or a file that is none, makes it raise."""
    import trimesh

    data, binary = path.read_bytes(), path.suffix.lower() == ".glb"
    begin = HEADER.size + CHUNK.size if binary else 0
    end = begin + CHUNK.unpack_from(data, HEADER.size)[0] if binary else len(data)
    tree = json.loads(data[begin:end])
    materials = tree.setdefault("materials", [])
    for primitive in (p for mesh in tree.get("meshes", ()) for p in mesh["primitives"]):
        primitive.setdefault("material", len(materials))
    materials.append({})
    text = json.dumps(tree).encode()
    if binary:
        text += b" " * (-len(text) % 4)
        text = HEADER.pack(b"glTF", 2, begin + len(text) + len(data) - end) + CHUNK.pack(len(text), b"JSON") + text + data[end:]
    beside = trimesh.resolvers.FilePathResolver(str(path))  # where its textures and buffers lie
    return trimesh.load(BytesIO(text), file_type=path.suffix[1:].lower(), resolver=beside, process=False)
