"""Radiance .hdr images: shared-exponent RGBE, flat or in the scanline run-length form (Ward, "Real Pixels", Graphics Gems II)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from scenes.atomic import atomic_file

_MAX_HEADER = 1 << 16


def load_hdr(path: str | os.PathLike) -> torch.Tensor:
    """Linear radiance `[H, W, 3]` float32, top row first. ValueError where the file is not a whole RGBE image."""
    path = Path(path)
    data = path.read_bytes()
    height, width, exposure, offset = _read_header(path, data)
    # the shortest row of run-length form is a 4 byte mark and, per channel, two bytes for every 127 pixels
    least = height * min(4 * width, 4 + 8 * -(-width // 127))
    if len(data) - offset < least:
        raise ValueError(f"{path} is truncated: {height}x{width} pixels need at least {least} bytes, it has {len(data) - offset}")
    body = np.frombuffer(data, np.uint8, offset=offset)
    encoded = 8 <= width < 1 << 15 and tuple(body[:3]) == (2, 2, width >> 8)
    rgbe = _read_runs(path, body, height, width) if encoded else _read_flat(path, body, height, width)
    scale = np.ldexp(np.float32(1), rgbe[..., 3:].astype(np.int32) - 136) * (rgbe[..., 3:] > 0)
    return torch.from_numpy((rgbe[..., :3] * scale / np.float32(exposure)).astype(np.float32))


def save_hdr(path: str | os.PathLike, linear: torch.Tensor) -> None:
    """Write linear radiance `[H, W, 3]`; each channel to 1/256 of its pixel's largest. Negative light becomes 0."""
    image = linear.detach().cpu().numpy().astype(np.float64).clip(0)
    if not np.isfinite(image).all():
        raise ValueError(f"cannot write {path}: the image has values that are not finite")
    height, width, _ = image.shape
    mantissa, exponent = np.frexp(image.max(-1))
    exponent = np.where(mantissa * 256 >= 255.5, exponent + 1, exponent)  # where the largest channel rounds up to 256
    bits = np.rint(np.ldexp(image, (8 - exponent)[..., None]))
    black = (exponent < -127) | (bits.max(-1) == 0)
    if (exponent > 127).any():
        raise ValueError(f"cannot write {path}: RGBE holds at most 1.7e38, the image has {image.max():g}")
    rgbe = np.concatenate([bits, (exponent + 128)[..., None]], -1)
    rgbe = np.where(black[..., None], 0, rgbe).astype(np.uint8)
    with atomic_file(path) as partial, open(partial, "wb") as file:
        file.write(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode())
        if 8 <= width < 1 << 15:
            for row in rgbe:
                file.write(bytes([2, 2, width >> 8, width & 255]) + b"".join(_encode(channel) for channel in row.T))
        else:
            file.write(rgbe.tobytes())


def _read_header(path: Path, data: bytes) -> tuple[int, int, float, int]:
    """Height, width, exposure, and where the pixels start."""
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise ValueError(f"{path} is not a Radiance .hdr image: it does not start with #?RADIANCE")
    end = data.find(b"\n\n", 0, _MAX_HEADER)
    stop = data.find(b"\n", end + 2, _MAX_HEADER)
    if end < 0 or stop < 0:
        raise ValueError(f"{path} is truncated: its header does not end")
    exposure = 1.0
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        key, _, value = line.partition("=")
        if key == "FORMAT" and value.strip() != "32-bit_rle_rgbe":
            raise ValueError(f"{path} holds {value.strip()}; only 32-bit_rle_rgbe is read")
        if key == "EXPOSURE":
            exposure *= float(value)
    words = data[end + 2 : stop].split()
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X" or not (words[1] + words[3]).isdigit():
        raise ValueError(f'{path} has the size line {data[end + 2 : stop][:40]!r}; only "-Y height +X width" is read')
    height, width = int(words[1]), int(words[3])
    if height < 1 or width < 1 or not exposure > 0:
        raise ValueError(f"{path} is corrupt: {width}x{height} pixels, exposure {exposure}")
    return height, width, exposure, stop + 1


def _read_flat(path: Path, body: np.ndarray, height: int, width: int) -> np.ndarray:
    if body.size != height * width * 4:
        raise ValueError(f"{path} is corrupt: {height}x{width} pixels are {height * width * 4} bytes, it has {body.size}")
    return body.reshape(height, width, 4)


def _read_runs(path: Path, body: np.ndarray, height: int, width: int) -> np.ndarray:
    out = np.empty((height, 4, width), np.uint8)
    raw, at = body.tobytes(), 0
    mark = bytes([2, 2, width >> 8, width & 255])
    for y in range(height):
        if raw[at : at + 4] != mark:
            raise ValueError(f"{path} is truncated or corrupt at row {y} of {height}")
        at += 4
        for channel in out[y]:
            x = 0
            while x < width:
                count = raw[at] if at < len(raw) else 0
                run = count > 128
                count -= 128 if run else 0
                piece = body[at + 1 : at + 2] if run else body[at + 1 : at + 1 + count]
                if count == 0 or x + count > width or piece.size != (1 if run else count):
                    raise ValueError(f"{path} is truncated or corrupt at row {y} of {height}")
                channel[x : x + count] = piece
                at, x = at + 1 + piece.size, x + count
    return out.transpose(0, 2, 1)


def _encode(channel: np.ndarray) -> bytes:
    """One channel of a row: runs of 4 to 127 equal bytes as (128 + length, byte), others as (length, bytes)."""
    starts = np.flatnonzero(np.diff(channel, prepend=channel[0] ^ 1))
    lengths = np.diff(starts, append=channel.size)
    out, plain = bytearray(), bytearray()

    def flush():
        for i in range(0, len(plain), 128):
            piece = plain[i : i + 128]
            out.append(len(piece))
            out.extend(piece)
        plain.clear()

    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        value = int(channel[start])
        if length < 4:
            plain.extend([value] * length)
            continue
        flush()
        for i in range(0, length, 127):
            out.extend((128 + min(127, length - i), value))
    flush()
    return bytes(out)
