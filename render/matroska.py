"""Whether a Matroska or WebM file is whole: FFmpeg takes one that breaks off for one that ends there."""

from __future__ import annotations

from pathlib import Path

EBML, SEGMENT = bytes.fromhex("1A45DFA3"), bytes.fromhex("18538067")
"""The elements that such a file consists of: a header, and all the rest (RFC 8794, RFC 9559)."""


def lacking(path: Path) -> int:
    """Bytes by which a file ends before its segment does; 0 where it does not, does not say, or is of another kind."""
    with open(path, "rb") as file:
        head = file.read(4096) + bytes(16)
    if not head.startswith(EBML):
        return 0
    size, start = _size(head, len(EBML))
    begins = start + (size or 0)
    if head[begins : begins + len(SEGMENT)] != SEGMENT:
        return 0
    size, start = _size(head, begins + len(SEGMENT))
    return 0 if size is None else max(0, start + size - path.stat().st_size)


def _size(head: bytes, at: int) -> tuple[int | None, int]:
    """An element's size in bytes, None where it is unknown, and where its content begins. As many zeros as lead, so many bytes follow."""
    length = 9 - head[at].bit_length()
    most = (1 << 7 * length) - 1
    size = int.from_bytes(head[at : at + length], "big") & most
    return None if size == most else size, at + length
