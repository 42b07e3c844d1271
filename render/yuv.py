"""Between the frames of PyAV, which are mostly YUV, and RGB bytes. PyAV is loaded when first used."""

from __future__ import annotations

from typing import Any

import numpy as np

BT709, UNTOLD = 1, 2  # code points of ITU-T H.273, for primaries, transfer and matrix alike
HDR = {16: "PQ", 18: "HLG"}
"""Transfers of high dynamic range, by code point: shown as if they were BT.709, pictures are pale."""
HD_ROWS = 720
"""Rows from which a video that does not tell its matrix has BT.709's, as players take it, and else BT.601's."""
TO_SDR = "zscale=t=linear:npl=100,format=gbrpf32le,zscale=p=bt709,tonemap=hable,zscale=t=bt709:m=bt709:r=tv,format=yuv420p"
"""FFmpeg's filters from high dynamic range to BT.709."""


def to_rgb(frame: Any) -> np.ndarray:
    """uint8 `[H, W, 3]` of a frame of PyAV's, as it is stored."""
    from av.video.reformatter import Colorspace

    matrix = Colorspace.ITU709 if frame.colorspace == UNTOLD and frame.height >= HD_ROWS else None  # None: the frame's own
    return frame.to_ndarray(format="rgb24", src_colorspace=matrix, interpolation=_exact())


def from_rgb(pixels: np.ndarray) -> Any:
    """A frame of PyAV's, yuv420p by BT.709's matrix, of uint8 pixels `[H, W, 3]`."""
    from av import VideoFrame
    from av.video.reformatter import Colorspace

    frame = VideoFrame.from_ndarray(pixels, format="rgb24")
    return frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, interpolation=_exact())


def _exact() -> int:
    """How swscale rounds to nearest: its fast paths cut off, and each way through them would be a level darker."""
    from av.video.reformatter import Interpolation

    return Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
