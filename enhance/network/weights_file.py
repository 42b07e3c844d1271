"""The enhancer's weights on disk: safetensors in half precision, the sizes and where they come from in the header."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from shlex import quote

import torch

from enhance.network.net import Net, NetConfig
from scenes.atomic import atomic_file

BUILTIN = Path(__file__).parents[1] / "weights" / "builtin.safetensors"
FORMAT = "sidestep-enhancer-1"

WORTH = 0.2
"""Gain in dB on pairs, held-out ones where there are any, from which a network repairs rendered frames at all."""

REPAIR_GAIN = "repair gain, dB"
"""Under what name the header says that gain (`enhance.training.gain.repair_gain`): alone, and beside what photos say."""


def save_net(net: Net, path: str | Path, about: dict) -> None:
    """Write `net` to `path`; `about` is json-like: data, licence, attribution, seed, steps, minutes, command."""
    from safetensors.torch import save

    state = {name: value.detach().to("cpu", torch.float16).contiguous() for name, value in net.state_dict().items()}
    with atomic_file(path) as half:
        # written by Python, whose error says that the disk is full
        half.write_bytes(save(state, {"format": FORMAT, "config": json.dumps(asdict(net.config)), "about": json.dumps(about)}))


def is_net(path: str | Path) -> bool:
    """Whether a file claims to be an enhancer of ours, or nothing else could be said of it than that it is none."""
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        return not path.is_dir()
    try:
        with safe_open(path, "pt") as file:
            return (file.metadata() or {}).get("format") == FORMAT
    except SafetensorError:
        return path.suffix == ".safetensors"


def load_net(path: str | Path) -> tuple[Net, dict]:
    """The network of a weights file, in float32 on the CPU, and what is said about it.

    Raises FileNotFoundError where there is no such file and ValueError where it is not whole or not an enhancer's.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f'no weights at {path}; write "builtin" for the shipped ones, fetch a public model and give where it lies, '
            f"or train some: sidestep train PAIRS -o {quote(str(path.parent))}"
        )
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            state = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - not a dict
    except SafetensorError as error:
        raise ValueError(f"{path} is not a valid safetensors file ({error}); fetch or train it again") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} is not a Sidestep enhancer: its format is {header.get('format')!r}, not {FORMAT!r}")
    try:
        known = {f.name for f in fields(NetConfig)}
        net = Net(NetConfig(**{k: int(v) for k, v in json.loads(header["config"]).items() if k in known}))
        about = dict(json.loads(header.get("about", "{}")))
    except (AssertionError, AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:  # torch's own, of sizes that are none
        raise ValueError(f"{path} has a broken header ({error}); fetch or train it again") from error
    _check_state(path, net, state)
    net.load_state_dict(state)
    return net, about


def _check_state(path: Path, net: Net, state: dict[str, torch.Tensor]) -> None:
    wanted = net.state_dict()
    for name in sorted(wanted.keys() | state.keys()):
        if name not in state or name not in wanted:
            raise ValueError(f"{path} {'lacks' if name not in state else 'has an unknown'} tensor {name}; it belongs to another version")
        if state[name].shape != wanted[name].shape:
            raise ValueError(f"{path}: {name} has shape {tuple(state[name].shape)}, wanted {tuple(wanted[name].shape)}")
        if not torch.isfinite(state[name]).all():
            raise ValueError(f"{path}: {name} holds values that are not finite; train again")
