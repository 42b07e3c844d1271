"""A glTF mesh as trimesh reads it, but for what has no material: that gets the format's default one, white and opaque.

Without one trimesh takes vertex colours of 16 bits for bytes, and has a colour of its own for those that lack them.
"""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote

from recon.assets.beside import beside
from scenes.formats.gltf import CHUNK, HEADER, read_glb

SUFFIXES = (".glb", ".gltf")

READ = ("KHR_materials_", "KHR_lights_punctual", "KHR_mesh_quantization", "EXT_texture_webp")
"""How the names of extensions begin without which, or with which, a mesh that requires them looks the same here."""


def load_gltf(path: Path):
    """trimesh's scene of a .glb or .gltf file. Raises whatever trimesh, or a file that is none, makes it raise, and ValueError for what
    trimesh would leave out, or read otherwise than it is meant."""
    import trimesh

    tree, binary = read_glb(path) if path.suffix.lower() == ".glb" else (json.loads(path.read_bytes()), None)
    _check_read(tree)
    _find_files(tree, path.parent)
    materials = tree.setdefault("materials", [])
    for primitive in (p for mesh in tree.get("meshes", ()) for p in mesh["primitives"]):
        primitive.setdefault("material", len(materials))
    materials.append({})
    text = json.dumps(tree).encode()
    if binary is not None:
        text += b" " * (-len(text) % 4)
        chunks = CHUNK.pack(len(text), b"JSON") + text
        if len(binary):
            chunks += CHUNK.pack(len(binary), b"BIN\0") + binary.tobytes()
        text = HEADER.pack(b"glTF", 2, HEADER.size + len(chunks)) + chunks
    beside = trimesh.resolvers.FilePathResolver(str(path))  # where its textures and buffers lie
    return trimesh.load(BytesIO(text), file_type=path.suffix[1:].lower(), resolver=beside, process=False)


def _find_files(tree: dict, folder: Path) -> None:
    """Write the names of files as they are, of which trimesh knows no %20. ValueError where one of them is not there."""
    for entry in (e for kind in ("images", "buffers") for e in tree.get(kind, ()) if not e.get("uri", "data:").startswith("data:")):
        entry["uri"] = unquote(entry["uri"])
        beside(folder, entry["uri"])


def _check_read(tree: dict) -> None:
    """ValueError where an extension is required that is not read, and where numbers are stored as parts of a whole, which trimesh takes as
    they are."""
    for name in tree.get("extensionsRequired", ()):
        if not name.startswith(READ):
            raise ValueError(f"it requires {name}, which is not read; export it without, uncompressed")
    for primitive in (p for mesh in tree.get("meshes", ()) for p in mesh["primitives"]):
        for attribute in ("POSITION", "NORMAL", "TEXCOORD_0"):
            if attribute in primitive["attributes"] and tree["accessors"][primitive["attributes"][attribute]].get("normalized"):
                raise ValueError(f"its {attribute} are quantized, normalized whole numbers, which are not read; export it with float ones")
