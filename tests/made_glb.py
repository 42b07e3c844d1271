"""GLB files with another tree or another binary chunk."""

import json
import struct

NAME = "KHR_gaussian_splatting"


def rewritten(path, change, binary=None):
    """Change the JSON of a GLB file, and its binary chunk where one is given."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    body = data[28 + length :] if binary is None else binary
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", len(body), 0x004E4942) + body)
    return tree
