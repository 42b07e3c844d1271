"""Niantic's SPZ, versions 2 to 4 (github.com/nianticlabs/spz): about 64 bytes a splat before compression, each field a block of its own.

Positions 24-bit fixed point; opacities a byte; colours a byte each, 0.15 of the constant coefficient about the middle; log scales a
byte each, 1/16 from -10; rotations the largest of xyzw, 2 bits, and sign and 9 bits of each other term (version 2: xyz, a byte each);
harmonics a byte each, 1/128 about 0 (of degree 4, which version 4 knows, those of degree 3 are kept). Versions 2 and 3 are one gzip
stream behind a header of 16 bytes; version 4 has a plain header of 32 bytes, a table of sizes and a Zstandard stream for each block.
Splats stand y up and look along -z, "RUB" in its text, and are turned to z up when they are read, and back when they are written.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scenes.atomic import atomic_file
from scenes.formats.packing import (
    BYTE_LOGITS,
    MOST_BYTES,
    assembled,
    drop_largest,
    kept_harmonics,
    levels,
    opacities_from,
    restore_largest,
    stored,
    unit,
)
from scenes.formats.transform import Z_FROM_Y_UP, moved
from scenes.gaussians import SH_COUNTS, Gaussians

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4 = struct.Struct("<4sIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_ANTIALIASED, _EXTENDED = 0x1, 0x2
_COLOUR = 0.15
_COUNTS = (*SH_COUNTS, 25)  # harmonics of degree 4 are read past
_FRACTION = 12  # bits: a quarter of a millimetre, as Niantic's writer has it
_DEGREE_1_STEP, _HIGHER_STEP = 8, 16  # of 256 levels; its writer keeps 5 and 4 bits of harmonics, for the compressor's sake
_LEVEL = 12  # of zstd, as in its writer


def load_spz(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """The splats of an SPZ file, z up. ValueError where it is not one or not whole; `clean` answers for the values."""
    path = Path(path)
    return clean(moved(unpacked(path.read_bytes(), str(path)), Z_FROM_Y_UP, path), str(path))


def unpacked(data: bytes, path: str) -> Gaussians:
    """The splats of an SPZ file's bytes in the file's own axes, with whatever values they have; errors name `path`."""
    if data.startswith(_GZIP):
        version, n, k, fraction, blocks = _read_gzip(path, data)
    elif data.startswith(_MAGIC):
        version, n, k, fraction, blocks = _read_zstd(path, data)
    else:
        raise ValueError(f"{path} is not an SPZ file: it starts with neither gzip's mark nor NGSP")
    positions, alphas, colours, scales, rotations, harmonics = (np.frombuffer(block, np.uint8) for block in blocks)
    fixed = np.zeros((n * 3, 4), np.uint8)
    fixed[:, 1:] = positions.reshape(n * 3, 3)  # in the upper bytes of an int32, so that the sign is where it belongs
    means = fixed.view("<i4").reshape(n, 3).astype(np.float32) * np.float32(2.0 ** -(8 + fraction))
    kept = kept_harmonics(k, path)
    sh = np.empty((n, kept, 3), np.float32)
    sh[:, 0] = ((np.arange(256) / 255 - 0.5) / _COLOUR).astype(np.float32)[colours].reshape(n, 3)
    sh[:, 1:] = ((np.arange(256) - 128) / 128).astype(np.float32)[harmonics.reshape(n, k - 1, 3)[:, : kept - 1]]
    log_scales = (np.arange(256) / 16 - 10).astype(np.float32)[scales].reshape(n, 3)
    quats = _first_three(rotations.reshape(n, 3)) if version == 2 else _smallest_three(rotations.view("<u4"))
    return assembled(means, quats, log_scales, BYTE_LOGITS[alphas], sh)


def antialiased(path: Path) -> bool:
    """Whether a file's header says that its splats were trained with antialiasing."""
    with open(path, "rb") as file:
        head = file.read(4096)
    if head.startswith(_GZIP):
        head = zlib.decompressobj(31).decompress(head, _HEADER.size)
    return bool(_HEADER.unpack(head[: _HEADER.size])[5] & _ANTIALIASED)


def save_spz(path: str | os.PathLike, gaussians: Gaussians, version: int = 4, antialias: bool = False) -> None:
    """Write splats that are z up as version 2, 3 or 4, y up. Positions get fewer bits after the point where metres need more before it.
    antialias: how they were trained.

    ValueError where a position is beyond 8388 km, which 24 bits cannot hold.
    """
    g, k = stored(moved(gaussians, Z_FROM_Y_UP.T, Path(path))), gaussians.sh.shape[1]
    largest = float(np.abs(g["means"]).max(initial=0))
    fraction = next((bits for bits in range(_FRACTION, -1, -1) if largest * 2**bits <= 2**23 - 1), None)
    if fraction is None:
        raise ValueError(f"{path}: a splat is {largest:.6g} m from the origin; SPZ holds 8388607 m at most")
    fixed = np.ascontiguousarray(np.rint(g["means"].astype(np.float64) * 2**fraction), "<i4")
    sh = np.rint(g["sh"][:, 1:].astype(np.float64) * 128) + 128
    steps = np.where(np.arange(1, k) < 4, _DEGREE_1_STEP, _HIGHER_STEP)[:, None]
    blocks = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        levels(opacities_from(g["logit_opacities"]), 255),
        levels(g["sh"][:, 0] * _COLOUR + 0.5, 255),
        np.rint((g["log_scales"].astype(np.float64) + 10) * 16).clip(0, 255),
        _pack_first_three(g["quats"]) if version == 2 else _pack_smallest_three(g["quats"]),
        ((sh + steps // 2) // steps * steps).clip(0, 255),
    ]
    plain = [block.astype(np.uint8).tobytes() for block in blocks]
    about = _MAGIC, version, len(gaussians), gaussians.sh_degree, fraction, _ANTIALIASED * antialias
    with atomic_file(path) as partial, open(partial, "wb") as file:
        if version < 4:
            squeeze = zlib.compressobj(6, zlib.DEFLATED, 31)
            file.write(squeeze.compress(_HEADER.pack(*about, 0)))
            for block in plain:
                file.write(squeeze.compress(block))
            file.write(squeeze.flush())
        else:
            import zstandard

            plain = [block for block in plain if block]
            streams = [zstandard.ZstdCompressor(level=_LEVEL).compress(block) for block in plain]
            file.write(_HEADER_4.pack(*about, len(streams), _HEADER_4.size))
            for stream, block in zip(streams, plain, strict=True):
                file.write(_SIZES.pack(len(stream), len(block)))
            file.writelines(streams)


def _read_gzip(path: str, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    """Version, splats, harmonics, bits after the point, and the six blocks, of version 2 or 3."""
    stream = zlib.decompressobj(31)
    try:
        head = stream.decompress(data, _HEADER.size)
        if len(head) < _HEADER.size or not head.startswith(_MAGIC):
            raise ValueError(f"{path} is not an SPZ file: what it has compressed does not start with NGSP")
        _, version, n, degree, fraction, flags, _ = _HEADER.unpack(head)
        sizes = _block_sizes(path, len(data), version, n, degree, fraction)
        body = stream.decompress(stream.unconsumed_tail, sum(sizes) + 1)
        more = len(body) > sum(sizes)
        if not more and (len(body) < sum(sizes) or not stream.eof):
            raise ValueError(f"{path} is truncated: its header claims {n} splats, {sum(sizes)} bytes, but it has {len(body)}")
    except zlib.error as error:
        raise ValueError(f"{path} is corrupt: {error}") from error
    if more and not flags & _EXTENDED:
        raise ValueError(f"{path} is corrupt: its header claims {n} splats, {sum(sizes)} bytes, but it has more")
    ends = np.cumsum([0, *sizes])
    return version, n, _COUNTS[degree], fraction, [body[a:b] for a, b in zip(ends, ends[1:], strict=False)]


def _read_zstd(path: str, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    """As `_read_gzip`, of version 4."""
    import zstandard

    if len(data) < _HEADER_4.size:
        raise ValueError(f"{path} is truncated: it has {len(data)} bytes of a header of {_HEADER_4.size}")
    _, version, n, degree, fraction, _, count, table = _HEADER_4.unpack(data[: _HEADER_4.size])
    sizes = _block_sizes(path, len(data), version, n, degree, fraction)
    present = [i for i, size in enumerate(sizes) if size]
    at = table + count * _SIZES.size
    if version < 4 or table < _HEADER_4.size or count != len(present) or at > len(data):
        raise ValueError(f"{path} is corrupt: its header claims version {version}, {count} streams for {n} splats of SH degree {degree}")
    blocks = [b""] * len(sizes)
    for row, i in enumerate(present):
        packed, plain = _SIZES.unpack_from(data, table + row * _SIZES.size)
        if plain != sizes[i] or at + packed > len(data):
            raise ValueError(f"{path} is truncated or corrupt: stream {row} claims {packed} bytes for {plain}, where {sizes[i]} are due")
        try:
            # as a reader, which grows with what comes out: the frame's own claim of its size is not to be trusted
            with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data[at : at + packed]) as reader:
                blocks[i] = reader.read(plain + 1)
        except zstandard.ZstdError as error:
            raise ValueError(f"{path} is corrupt: stream {row}: {error}") from error
        if len(blocks[i]) != plain:
            raise ValueError(f"{path} is corrupt: stream {row} holds {len(blocks[i])} bytes or more, where {plain} are due")
        at += packed
    return version, n, _COUNTS[degree], fraction, blocks


def _block_sizes(path: str, size: int, version: int, n: int, degree: int, fraction: int) -> list[int]:
    """Bytes of the six blocks; ValueError where the header's numbers cannot be."""
    if version not in (2, 3, 4):
        raise ValueError(f"{path} is SPZ version {version}; versions 2 to 4 are read")
    if degree >= len(_COUNTS):
        raise ValueError(f"{path} has spherical harmonics of degree {degree}; 0 to 4 are read")
    if fraction > 24:
        raise ValueError(f"{path} is corrupt: it claims {fraction} bits after the point of 24")
    sizes = [n * width for width in (9, 1, 3, 3, 3 if version == 2 else 4, 3 * (_COUNTS[degree] - 1))]
    if sizes[0] > MOST_BYTES * size:
        raise ValueError(f"{path} is truncated or corrupt: its header claims {n} splats, but it has {size} bytes")
    return sizes


def _first_three(xyz: np.ndarray) -> np.ndarray:
    xyz = xyz / np.float32(127.5) - 1
    return np.concatenate([np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(1, keepdims=True))), xyz], 1)


def _pack_first_three(quats: np.ndarray) -> np.ndarray:
    quats = unit(quats)
    return levels((quats[:, 1:] * np.where(quats[:, :1] < 0, -1, 1) + 1) / 2, 255)


def _smallest_three(words: np.ndarray) -> np.ndarray:
    signed = np.arange(512) * np.float32(0.5**0.5 / 511)
    terms = np.concatenate([signed, -signed])
    return restore_largest(words >> 30, np.stack([terms[words >> shift & 0x3FF] for shift in (20, 10, 0)]))[:, [3, 0, 1, 2]]


def _pack_smallest_three(quats: np.ndarray) -> np.ndarray:
    which, three = drop_largest(quats[:, [1, 2, 3, 0]])
    fields = levels(np.abs(three) * 2**0.5, 511).astype(np.uint32) | (three < 0).astype(np.uint32) << 9
    words = which.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words.astype("<u4").view(np.uint8)
