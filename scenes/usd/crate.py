"""What USD's binary files (crates) claim, checked before USD's own library believes it: that reserves memory for any claim.

After PXR-USDC, a version and the place of a table of sections, each section says how many entries it has; a field's value, if it is an
array, stands at a place of the file behind its count (pxr/usd/sdf/crateFile.h of OpenUSD). No more can be there than the file's bytes
hold, LZ4 and USD's coding of whole numbers unpacking to at most `MOST` values a byte.
"""

from __future__ import annotations

import struct
from pathlib import Path

MAGIC = b"PXR-USDC"
MOST = 4 * 255
_HEADER = struct.Struct("<8s8BQ")
_SECTION = struct.Struct("<16sqq")
_WORD = struct.Struct("<Q")
_ARRAY, _INLINED, _COMPRESSED, _PLACE = 1 << 63, 1 << 62, 1 << 61, (1 << 48) - 1
_BYTES = {
    1: 1, 2: 1, 3: 4, 4: 4, 5: 8, 6: 8, 7: 2, 8: 4, 9: 8, 10: 4, 11: 4, 12: 4, 13: 32, 14: 72, 15: 128, 16: 32, 17: 16, 18: 8, 19: 16,
    20: 8, 21: 4, 22: 8, 23: 24, 24: 12, 25: 6, 26: 12, 27: 32, 28: 16, 29: 8, 30: 16, 56: 8,
}  # fmt: skip
"""Bytes a value of each type that arrays are made of, by crateDataTypes.h."""
_VECTORS = {40: 4, 41: 4, 48: 8, 49: 16, 50: 4}
"""As `_BYTES`, of the types that are lists in themselves: paths, tokens, doubles, layer offsets, strings."""


def check_crate(path: Path) -> None:
    """Raise ValueError where a crate claims more than its bytes can hold; other files pass."""
    with open(path, "rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return
    data = path.read_bytes() if path.stat().st_size < 1 << 16 else _mapped(path)
    try:
        _check(data)
    except (struct.error, IndexError, OverflowError) as error:
        raise ValueError(f"{path} is not a valid USD file: it ends before what it claims to hold") from error
    except ValueError as error:
        raise ValueError(f"{path} is not a valid USD file: {error}") from error


def _mapped(path: Path) -> memoryview:
    import mmap

    with open(path, "rb") as file:
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _check(data: bytes | memoryview) -> None:
    _, *version, table = _HEADER.unpack_from(data)
    (count,) = _WORD.unpack_from(data, table)
    if count > 64:
        raise ValueError(f"it claims {count} sections")
    for i in range(count):
        name, start, size = _SECTION.unpack_from(data, table + _WORD.size + i * _SECTION.size)
        if start < 0 or size < 0 or start + size > len(data):
            raise ValueError(f"its section {name.rstrip(bytes(1)).decode('latin-1')} claims {size} bytes at {start} of {len(data)}")
        words = [_WORD.unpack_from(data, start + at)[0] for at in range(0, min(size, 24) - 7, 8)]
        if words and words[0] > MOST * size:
            raise ValueError(f"its section {name.rstrip(bytes(1)).decode('latin-1')} claims {words[0]} entries in {size} bytes")
        if name.startswith(b"TOKENS\0") and len(words) == 3 and words[1] > 255 * words[2]:
            raise ValueError(f"its tokens claim {words[1]} characters in {words[2]} bytes")
        if name.startswith(b"FIELDS\0") and tuple(version[:2]) >= (0, 4):
            _check_fields(data, start, words[0], 8 if tuple(version[:2]) >= (0, 7) else 4)


def _check_fields(data: bytes | memoryview, start: int, count: int, width: int) -> None:
    """Check the counts, `width` bytes each, of all fields that are arrays or lists."""
    (names,) = _WORD.unpack_from(data, start + 8)
    (size,) = _WORD.unpack_from(data, start + 16 + names)
    packed = bytes(data[start + 24 + names : start + 24 + names + size])
    for (value,) in _WORD.iter_unpack(_unpacked(packed, 8 * count)):
        kind, place = value >> 48 & 0xFF, value & _PLACE
        if value & _INLINED or not (value & _ARRAY or kind in _VECTORS) or not place:
            continue
        claimed = int.from_bytes(data[place : place + width], "little")
        room = len(data) - place - width
        least = _VECTORS[kind] if not value & _ARRAY else _BYTES.get(kind, 1)
        if claimed > (MOST * room if value & _COMPRESSED else room // least):
            raise ValueError(f"an array claims {claimed} values of {least} bytes; {max(0, room)} bytes follow")


def _unpacked(packed: bytes, size: int) -> bytes:
    """What OpenUSD's TfFastCompression packed: LZ4 blocks behind how many there are, 0 for one alone; at most `size` bytes."""
    if not packed:
        return b""
    if packed[0] == 0:
        return _lz4(packed[1:], size)
    out, at = b"", 1
    for _ in range(packed[0]):
        length = int.from_bytes(packed[at : at + 4], "little")
        out += _lz4(packed[at + 4 : at + 4 + length], size - len(out))
        at += 4 + length
    return out


def _lz4(block: bytes, size: int) -> bytes:
    """An LZ4 block unpacked (lz4_Block_format.md): runs of plain bytes, each but the last followed by a piece of what came before."""
    out, at = bytearray(), 0

    def length(base: int) -> int:
        nonlocal at
        if base == 15:
            while (more := block[at]) == 255:
                base, at = base + 255, at + 1
            base, at = base + more, at + 1
        return base

    while at < len(block):
        token = block[at]
        at += 1
        plain = length(token >> 4)
        out += block[at : at + plain]
        at += plain
        if at >= len(block):
            break
        back = block[at] | block[at + 1] << 8
        at += 2
        again = length(token & 15) + 4
        if not 0 < back <= len(out) or len(out) + again > size:
            raise ValueError("its fields are packed wrongly")
        for _ in range(again):
            out.append(out[-back])
    if len(out) > size or len(out) % 8:
        raise ValueError("its fields are packed wrongly")
    return bytes(out)
