"""`python -m tests.pretend_cuda MODULE ARGUMENTS...` runs a module (`sidestep`, `enhance.evaluate`, `pytest`) on a GPU that is not there.

Tensors that a program puts on "cuda" stay on the host and are marked; what meets a mark is marked, and what a GPU would refuse is refused:
host and GPU tensors in one operation, `.numpy()` of a GPU tensor. Kernels run on the CPU, lanes in place of blocks of threads. This tests
the Python that a command with `--device cuda` runs, which no machine without a GPU runs otherwise; what the CUDA kernels compute is tested
in tests/render/test_cuda.py.
"""

import runpy
import sys
import threading
from contextlib import contextmanager
from functools import wraps
from types import SimpleNamespace

import torch
import warp as wp
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils._pytree import tree_iter, tree_map_only

CUDA, CPU = torch.device("cuda", 0), torch.device("cpu")

_marks: dict[int, StorageWeakRef] = {}
"""Storages that are taken for a GPU's, by their addresses, which are not used again while a weak reference lasts."""


def _mark(tensor: torch.Tensor) -> None:
    storage = tensor.untyped_storage()
    _marks[storage._cdata] = StorageWeakRef(storage)
    if len(_marks) % 4096 == 0:
        for gone in [address for address, mark in _marks.items() if mark.expired()]:
            del _marks[gone]


def _marked(tensor: torch.Tensor) -> bool:
    if tensor.is_meta or tensor.is_sparse:
        return False
    address = tensor.untyped_storage()._cdata
    mark = _marks.get(address)
    return mark is not None and not mark.expired()


class _Here(threading.local):
    backward = 0
    """Within how many calls of backward this thread is: what autograd makes there is not seen, and taken for the GPU's."""


_here = _Here()


class PretendCuda(TorchFunctionMode):
    """See the module's docstring."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = getattr(function, "__name__", "")
        if name == "__get__":
            return _attribute(function, *args)
        wanted = torch.device(kwargs["device"]).type if kwargs.get("device") is not None else None
        if wanted == "cuda":
            kwargs["device"] = CPU
        if name in ("to", "cuda", "cpu"):
            return _moved(function, name, args, kwargs, wanted)
        tensors = [t for t in tree_iter((args, kwargs)) if isinstance(t, torch.Tensor)]
        there = [_marked(t) for t in tensors]
        if name == "_has_compatible_shallow_copy_type":
            return there[0] == there[1]
        if name in ("numpy", "__array__") and there[0]:
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first.")
        if name == "pin_memory":
            if there[0]:
                raise RuntimeError("cannot pin 'torch.cuda.FloatTensor' only dense CPU tensors can be pinned")
            return args[0].clone()
        kwargs.pop("pin_memory", None)
        if any(there) and not _here.backward:
            _check(name, function, args, tensors, there)
        out = function(*args, **kwargs)
        if there[0] if name in LIKE_THE_FIRST else any(there) if wanted is None else wanted == "cuda":
            tree_map_only(torch.Tensor, _mark, out)
        return out


LIKE_THE_FIRST = ("copy_", "set_", "__set__", "__getitem__", "__setitem__", "index_put_")
"""What may mix devices, some in one direction only."""


def _check(name: str, function, args, tensors: list[torch.Tensor], there: list[bool]) -> None:
    """RuntimeError where a GPU would have nothing to do with tensors elsewhere; single numbers of the host's are told to it."""
    if name in ("__getitem__", "__setitem__", "index_put_"):
        value = tensors[-1] if tensors[-1] is args[-1] and name != "__getitem__" else None
        if not there[0] and any(there[1:]) and not (value is not None and value.ndim == 0):
            raise RuntimeError(f"{name}: indices or values are on cuda:0, what is indexed is on cpu")
        if there[0] and value is not None and not there[-1] and value.ndim:
            raise RuntimeError(f"{name}: the values are on cpu, what is indexed is on cuda:0")
    elif name not in LIKE_THE_FIRST and any(not cuda and t.ndim for t, cuda in zip(tensors, there, strict=True)):
        where = resolve_name(function) or name
        raise RuntimeError(f"Expected all tensors to be on the same device, but found cuda:0 and cpu in {where}")


def _attribute(getter, tensor, *args):
    """What a tensor says of itself; views, its gradient among them, are where it is."""
    there = _marked(tensor)
    told = {"device": CUDA if there else CPU, "is_cuda": there, "is_cpu": not there}
    of = getattr(getter.__self__, "__name__", "")
    if of in told:
        return told[of]
    out = getter(tensor, *args)
    if there and isinstance(out, torch.Tensor):
        _mark(out)
    return out


def _moved(function, name: str, args, kwargs, wanted: str | None) -> torch.Tensor:
    """`to`, `cuda` and `cpu`: a copy where the device is another."""
    tensor, *rest = args
    goal = wanted if name == "to" else name
    if name == "to" and rest:
        first = rest[0]
        if isinstance(first, torch.Tensor):
            goal = "cuda" if _marked(first) else "cpu"
        elif isinstance(first, (str, torch.device)):
            goal, rest[0] = torch.device(first).type, CPU
    was = _marked(tensor)
    out = function(tensor, *rest, **kwargs) if name == "to" else tensor
    is_there = was if goal is None else goal == "cuda"
    if is_there != was and out.untyped_storage()._cdata == tensor.untyped_storage()._cdata:
        out = out.clone()
    if is_there:
        _mark(out)
    return out


def _around_backward(function):
    """A graph's backward: autograd and our Functions' backward make tensors unseen."""

    @wraps(function)
    def backward(*args, **kwargs):
        roots = [t for t in tree_iter((args, kwargs)) if isinstance(t, torch.Tensor)]
        if not any(_marked(t) for t in roots):
            return function(*args, **kwargs)
        _here.backward += 1
        try:
            out = function(*args, **kwargs)
        finally:
            _here.backward -= 1
        tree_map_only(torch.Tensor, _mark, out)
        return out

    return backward


class _Generator(torch.Generator):
    """Of a GPU that is not there: it draws on the host."""

    def __new__(cls, device="cpu"):
        return super().__new__(cls, CPU)


class _Event:
    def record(self, stream=None) -> None:
        pass

    def synchronize(self) -> None:
        pass


def _there(function, at: int = 0):
    """A function of torch that takes the kind of a device as its argument `at`, told "cpu" instead."""

    @wraps(function)
    def told(*args, **kwargs):
        return function(*("cpu" if i == at and a == "cuda" else a for i, a in enumerate(args)), **kwargs)

    return told


def _plainly(function):
    """A function that looks at tensors itself."""

    @wraps(function)
    def plain(*args, **kwargs):
        with torch._C.DisableTorchFunction():
            return function(*args, **kwargs)

    return plain


@contextmanager
def _nothing(*args, **kwargs):
    yield


def pretend() -> None:
    """From here on, on all threads, there is a GPU. For a process of its own: nothing takes this back."""
    from render import compositing, launch

    compositing.by_blocks = lambda device: False
    by_lanes = _plainly(compositing._composite)

    def composite(settings, w, lists, scene):
        out = by_lanes(settings, w, lists, scene)
        if _marked(scene.records):
            tree_map_only(torch.Tensor, _mark, out)
        return out

    compositing._composite = composite
    ready = launch._ready
    launch._ready = lambda kernel, device: ready(kernel, "cpu")
    wp.from_torch = _plainly(wp.from_torch)
    wp.device_from_torch = lambda device: wp.get_device("cpu")
    wp.stream_from_torch = lambda stream: None
    wp.ScopedStream = _nothing
    torch.cuda.is_available = lambda: True
    torch.cuda.is_bf16_supported = lambda *_: True
    torch.cuda.get_device_name = lambda *_: "a GPU that is not there"
    torch.cuda.current_stream = lambda *_: SimpleNamespace(cuda_stream=0)
    torch.cuda.synchronize = lambda *_: None
    torch.cuda.Event = _Event
    torch.Generator = _Generator
    torch.is_autocast_enabled, torch.get_autocast_dtype = _there(torch.is_autocast_enabled), _there(torch.get_autocast_dtype)
    torch.autocast.__init__ = _there(torch.autocast.__init__, 1)
    torch.autograd.backward, torch.autograd.grad = _around_backward(torch.autograd.backward), _around_backward(torch.autograd.grad)
    run = threading.Thread.run

    def pretending(self) -> None:
        with PretendCuda():
            run(self)

    threading.Thread.run = pretending
    PretendCuda().__enter__()


if __name__ == "__main__":
    sys.argv = sys.argv[1:]
    pretend()
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
