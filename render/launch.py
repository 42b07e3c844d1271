"""The only place that launches kernels: device, stream, and bands of work on CPU threads.

Warp runs a CPU launch as one serial loop and releases the GIL, so bands on a thread pool scale. Bands write disjoint memory, which
makes the result the same bits on any number of threads.
"""

import math
import os
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
import warp as wp

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)


@contextmanager
def _keeping():
    """What makes Warp write down compiled kernels: OSError that says how to have another folder, where theirs takes none. Of a full disk
    Python names no file, and the clip's own would be blamed."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # a library that does not load
            raise
        told = f"compiled kernels cannot be kept in {wp.config.kernel_cache_dir}: {error.strerror}"
        raise OSError(f"{told}; name another folder, as WARP_CACHE_PATH=/tmp/kernels sidestep ...") from error


def _start() -> None:
    """Start Warp. Where there is no CUDA driver its native code says so on stderr, past every log level; that is no news here."""
    if torch.cuda.is_available():
        with _keeping():
            wp.init()
        return
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with _keeping():
            wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_start()

BANDS = 16
"""Bands of tiles a launch is cut into: enough to even out a busy part of the image, few enough to cost nothing."""


STRETCH = 64
"""Pixels in a row that an item does on the CPU, where taking up its arguments takes as long as a pixel or two. On CUDA it is one."""


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="sidestep-render")


def run(kernel: wp.Kernel, count: int, args: list, device: torch.device) -> None:
    """Launch `kernel` over `count` work items, inside a `stage`; its last parameter, `first`, is the index of a band's first item."""
    run_each(kernel, [(count, args)], device)


def run_pixels(kernel: wp.Kernel, pixels: int, args: list, device: torch.device) -> None:
    """Launch `kernel` over a picture's pixels, inside a `stage`; its last parameters are `stretch`, how many pixels in a row an item does,
    and `first`, as of `run`: `pixels_of` in `kernels/types.py` says which these are."""
    stretch = 1 if device.type == "cuda" else STRETCH
    run(kernel, -(-pixels // stretch), [*args, stretch], device)


def run_each(kernel: wp.Kernel, jobs: Sequence[tuple[int, list]], device: torch.device) -> None:
    """Launch `kernel` as `run` does over the items of several jobs, each with its own arguments, all side by side."""
    jobs = [(count, args) for count, args in jobs if count]
    if not jobs:
        return
    _ready(kernel, device.type)
    if device.type == "cuda":
        for count, args in jobs:
            wp.launch(kernel, dim=count, inputs=[*args, 0], device=wp.device_from_torch(device))
        return
    threads = _cores.threads
    bands = _bands(jobs, 1 if threads == 1 else BANDS)

    def band(pieces: list[tuple[int, int, list]]) -> None:
        for first, count, args in pieces:
            wp.launch(kernel, dim=count, inputs=[*args, first], device="cpu")

    if len(bands) == 1:
        band(bands[0])
    else:
        list(_pool(threads).map(band, bands))


def _bands(jobs: Sequence[tuple[int, list]], most: int) -> list[list[tuple[int, int, list]]]:
    """All items dealt to at most `most` bands of one size: first item, how many, and arguments of each piece of a job."""
    size = -(-sum(count for count, _ in jobs) // most)
    bands: list[list[tuple[int, int, list]]] = [[]]
    room = size
    for count, args in jobs:
        first = 0
        while first < count:
            if room == 0:
                bands.append([])
                room = size
            taken = min(room, count - first)
            bands[-1].append((first, taken, args))
            first, room = first + taken, room - taken
    return bands


PATIENCE = 0.7
"""Seconds that a kernel may take to load before a line says why; loading one that is compiled takes a hundredth of that."""


@cache
def _ready(kernel: wp.Kernel, device: str) -> None:
    """Compile before the threads start: they would all wait on one compiler."""
    said = threading.Timer(PATIENCE, _say_compiling)
    said.daemon = True
    said.start()
    try:
        # the block size belongs to what is compiled: with another one, the launch would compile everything once more
        with _keeping():
            kernel.module.load(device, block_dim=1 if device == "cpu" else None)
    finally:
        said.cancel()


@cache
def _say_compiling() -> None:
    print(f"sidestep: compiling kernels for this machine, once; they are kept in {wp.config.kernel_cache_dir}", file=sys.stderr, flush=True)


def run_blocks(kernel: wp.Kernel, blocks: int, block_dim: int, args: list, device: torch.device) -> None:
    """Launch a kernel in which a block of threads shares one work item (CUDA; a block is one thread on the CPU)."""
    if blocks:
        wp.launch_tiled(kernel, dim=[blocks], inputs=args, block_dim=block_dim, device=wp.device_from_torch(device))


@contextmanager
def stage(device: torch.device):
    """What is launched inside runs in order with torch: on its current CUDA stream, or on the CPU with the cores left to Warp.

    After every parallel operation torch's OpenMP workers spin for milliseconds on the cores that our bands need, which makes frames
    several times slower. So torch's own small operations between launches stay on this thread. (What `scenes/idle.py` sets before torch is
    loaded ends the spinning after the caller's operations soon, too.)
    """
    if device.type == "cuda":
        # nothing runs on Warp's own stream that this one should wait for
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False):
            yield
        return
    if _cores.staged:  # the outer stage has taken the cores
        yield
        return
    with _stages.lock:
        if not _stages.open:
            _stages.threads = _threads()
        _stages.open += 1
    _cores.threads, _cores.staged, _cores.known = _stages.threads, True, True
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_cores.threads)
        _cores.staged = False
        with _stages.lock:
            _stages.open -= 1


def stream_of(device: torch.device) -> int:
    """Which of a GPU's streams this thread's work goes to now; 0 on the CPU. What was made on one is there for it alone, until it is asked
    whether it is done: of what is kept, each has its own."""
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0


class _Cores(threading.local):
    """What a thread has of the cores, and whether it had a stage before."""

    threads = 1
    staged = False
    known = False


class _Stages:
    """All threads' open stages, and torch's threads before them. A thread that first uses torch during another's stage finds but one
    there, and would otherwise take that for its own and hand it on."""

    lock = threading.Lock()
    open = 0
    threads = 1


_cores, _stages = _Cores(), _Stages()


def _threads() -> int:
    """Torch's threads, while no stage is open."""
    own = torch.get_num_threads()
    if own > 1 or _cores.known:
        return own
    with ThreadPoolExecutor(1) as new:  # which is given what the process has, whatever this one found during another's stage
        return new.submit(torch.get_num_threads).result()


_SCALARS = {float: torch.float32, int: torch.int32}
"""Torch's name for what kernels call by Python's."""

_ARRAY: Any = type(wp.from_torch(torch.zeros(1), return_ctype=True))


def upload(tensor: torch.Tensor, device: torch.device) -> torch.Tensor:
    """A tensor of the host, there; a copy from memory that is not pinned would hold the host up until the device has done all before it."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" and tensor.device.type == "cpu" else tensor.to(device)


def view(tensor: torch.Tensor, dtype) -> object:
    """A torch tensor as a Warp array of `dtype`, no copy, no Python object: what `run` takes.

    As Warp's own `from_torch`, in half the time: a frame has two dozen of these, for which a GPU would wait. dtype: of a number, or of a
    vector or matrix, which are the last dimensions then. ValueError for another dtype or shape.
    """
    size, element = _layout(dtype, tensor.dtype)
    shape: tuple[int, ...] = tensor.shape
    strides = tensor.stride()
    if element:
        inner = len(element)
        if shape[-inner:] != element or strides[-1] != 1 or strides[-inner] != math.prod(element[1:]):
            raise ValueError(f"an array of {dtype.__name__} must end in {element}, one beside the other, got {tuple(shape)} by {strides}")
        shape, strides = shape[:-inner] or (1,), strides[:-inner] or (1,)
    array = _ARRAY(tensor.data_ptr(), 0, len(shape), shape, [size * stride for stride in strides])
    array._ref = tensor  # until it is launched
    return array


@cache
def _layout(dtype, kind: torch.dtype) -> tuple[int, tuple[int, ...]]:
    """Bytes of a number, and the shape of an element; () where that is a number."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    if (_SCALARS.get(scalar) or wp.dtype_to_torch(scalar)) != kind:
        raise ValueError(f"a kernel's array of {dtype.__name__} cannot be a tensor of {kind}")
    return kind.itemsize, getattr(dtype, "_shape_", ())
