"""Which public model is it? Decided by a file's content; opened without ever running what is in it but TorchScript."""

from __future__ import annotations

import io
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from enhance.public.layout import part
from enhance.public.model import Model
from enhance.step import Steps

if TYPE_CHECKING:
    from enhance.public.white_box import WhiteBox

KNOWN = (
    "NVIDIA Harmonizer (diffusion_harmonizer.pkl, harmonizer_nontemporal.pt), NVIDIA Fixer (pretrained_fixer.pkl with "
    "base/tokenizer_fast.pth beside it), the folder of Difix (nvidia/difix, nvidia/difix_ref) or Cosmos-Predict2 (model.pt with "
    "tokenizer/tokenizer.pth), or harmonizer.pth of Ke et al."
)

TRAINING = ("net_disc", "optimizer", "optimizer_disc")
"""What the trainings of Harmonizer, Fixer and Difix save beside the networks."""


def open_public(path: str | Path, device: str | torch.device = "cpu", **how) -> Steps:
    """The enhancer of a public checkpoint: a file or, where a release has several, its folder.

    `how`: as `PublicEnhancer` takes it. ValueError where it is not whole, or none of those that are known.
    """
    from enhance.public.enhancer import PublicEnhancer
    from enhance.public.white_box import WhiteBox, WhiteBoxEnhancer

    path = Path(path)
    model = _folder(path) if path.is_dir() else _file(path)
    weights = sum(value.numel() for value in model.parameters())
    about = {"model": model.name, "file": str(path), "weights used": weights, "unverified": "never run with the released weights here"}
    if isinstance(model, WhiteBox):
        return WhiteBoxEnhancer(model, about, device, **how)
    return PublicEnhancer(model, about | {"left out": list(model.left_out)}, device, **how)


def _folder(path: Path) -> Model:
    from enhance.public.difix import read_difix
    from enhance.public.harmonizer import read_cosmos

    transformer, vae = path / "model.pt", path / "tokenizer" / "tokenizer.pth"
    if transformer.is_file() and vae.is_file():
        return read_cosmos(transformer, read_state(transformer), read_state(vae), "Cosmos-Predict2", 0)
    if (path / "unet" / "config.json").is_file():
        return read_difix(path, read_state)
    if (path / "transformer" / "config.json").is_file():
        return _diffusers_cosmos(path)
    if (path / "enhancer.safetensors").is_file():
        raise ValueError(f"{path} is the folder of a training; give {path / 'enhancer.safetensors'}")
    raise ValueError(f"{path} holds no known model; give {KNOWN}")


def _diffusers_cosmos(path: Path) -> Model:
    """Cosmos-Predict2 in the folders of diffusers, by its releases' names."""
    from enhance.public.cosmos import STRETCH
    from enhance.public.diffusers_names import AUTOENCODER, TRANSFORMER, released
    from enhance.public.difix import config_of
    from enhance.public.harmonizer import read_cosmos

    config = config_of(path / "transformer" / "config.json")
    stretch = STRETCH.get(config.get("in_channels", 16) - 15)  # Video2World's condition mask is among the channels here
    wanted = {"_class_name": "CosmosTransformer3DModel", "extra_pos_embed_type": None, "rope_scale": [1.0, stretch, stretch]}
    for name, value in wanted.items():
        if config.get(name) != value:
            raise ValueError(f"{path}/transformer: {name} is {config.get(name)!r}, {value!r} in Cosmos-Predict2; give {KNOWN}")
    parts = [_shards(path / name) for name in ("transformer", "vae")]
    return read_cosmos(path, released(parts[0], TRANSFORMER), released(parts[1], AUTOENCODER), "Cosmos-Predict2", 0)


def _shards(folder: Path) -> dict:
    """The tensors of a folder of diffusers, whose file may be cut in several."""
    files = sorted(folder.glob("diffusion_pytorch_model*.safetensors"))
    if not files:
        raise ValueError(f"{folder} has no diffusion_pytorch_model.safetensors; fetch the model's folder again")
    return {name: value for file in files for name, value in read_state(file).items()}


def _file(path: Path) -> Model | WhiteBox:
    from enhance.public.harmonizer import Scripted, read_cosmos, read_fixer
    from enhance.public.white_box import WhiteBox

    if is_torchscript(path):
        return Scripted(path, _script(path))
    state = read_state(path)
    transformer, vae = state.get("state_dict_unet"), state.get("state_dict_vae")
    if isinstance(transformer, Mapping) and isinstance(vae, Mapping):
        transformer, vae = _named(transformer), _named(vae)
        if "rank_vae" in state:
            raise ValueError(f"{path} holds what Difix was trained by on top of SD-Turbo; give the folder nvidia/difix, which is whole")
        beside = {name: value for name, value in state.items() if name not in ("state_dict_unet", "state_dict_vae")}
        strange = sorted(n for n, v in beside.items() if n not in TRAINING and isinstance(v, Mapping | torch.Tensor))
        if strange:
            raise ValueError(f"{path} has the unknown part {strange[0]}; give {KNOWN}")
        left_out = (*sorted(beside), *sorted({name.split(".")[0] + ".*" for name in transformer if "_ema." in name}))
        if "conv1.weight" in vae or "encoder.conv1.weight" in vae:
            return _without(read_cosmos(path, transformer, vae, "NVIDIA Harmonizer", 4), left_out)
        if part(vae, "encoder.") and part(vae, "decoder."):
            tokenizer = _tokenizer(path)
            return _without(read_fixer(path, transformer, vae, tokenizer, read_state(tokenizer)), left_out)
    if "regressor.f.weight" in state:
        return WhiteBox.read(path, state)
    if any(name.removeprefix("net.").startswith("blocks.") for name in state):
        raise ValueError(f"{path} is the transformer of Cosmos-Predict2 alone; give its folder, with tokenizer/tokenizer.pth in it")
    if "encoder.conv1.weight" in state:
        raise ValueError(f"{path} is the Wan autoencoder alone; give the folder with model.pt in it, or a Harmonizer's .pkl")
    first = ", ".join(list(state)[:3])
    raise ValueError(f"{path} is not a known enhancer: it holds {first or 'nothing'}; give {KNOWN}")


def _without(model: Model, names: tuple[str, ...]) -> Model:
    model.left_out = names
    return model


def _tokenizer(path: Path) -> Path:
    """Where the tokenizer of a Fixer's base lies, in the folders that `hf download nvidia/Fixer` makes or beside the file."""
    near = path.parent
    places = [folder / "tokenizer_fast.pth" for folder in (near, near / "base", near.parent / "base")]
    for place in places:
        if place.is_file():
            return place
    raise ValueError(f"{path} is a Fixer, whose tokenizer's graph is in base/tokenizer_fast.pth of nvidia/Fixer; put that at {places[0]}")


def is_torchscript(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _script(path: Path) -> torch.jit.ScriptModule:
    """A TorchScript that makes a picture of a picture, as far as what it declares tells; ValueError for any other."""
    try:
        module = torch.jit.load(str(path), map_location="cpu")
    except RuntimeError as error:
        raise ValueError(f"{path} is not a valid TorchScript ({str(error).strip().splitlines()[0]}); fetch it again") from error
    schema = module.forward.schema if hasattr(module, "forward") else None
    takes = [str(a.type) for a in schema.arguments[1:] if not a.has_default_value()] if schema else []
    gives = [str(r.type) for r in schema.returns] if schema else []
    if takes != ["Tensor"] or gives != ["Tensor"]:
        what = f"takes {', '.join(takes) or 'nothing'} and gives {', '.join(gives) or 'nothing'}"
        raise ValueError(f"{path} is a TorchScript that {what}, where an enhancer takes one tensor and gives one; give {KNOWN}")
    return module


def read_state(path: Path) -> dict:
    """The tensors of a file that torch.save wrote, or of safetensors; large ones are mapped and read when they are used.

    ValueError where it is cut off, holds anything but tensors, numbers, text and bytes in dicts and lists, or is something else.
    """
    if path.is_file() and path.stat().st_size < 1024 and path.read_bytes().startswith(b"version https://git-lfs"):
        raise ValueError(f"{path} is not the file itself but Git LFS's pointer to it; fetch it by git lfs pull, or by hf download")
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except SafetensorError as error:
            raise ValueError(f"{path} is not a valid safetensors file ({error}); fetch it again") from error
    try:
        # Transformer Engine's state beside the weights is bytes, never run; torch warns of a pickle that it then refuses, or reads
        with torch.serialization.safe_globals([io.BytesIO]), warnings.catch_warnings(action="ignore", category=UserWarning):
            state = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except pickle.UnpicklingError as error:
        told = [line.strip() for line in str(error).splitlines() if "global" in line.lower()]
        why = told[0].split(". ")[0] if told else "it is no checkpoint, or damaged"  # what torch goes on with is how to run it
        raise ValueError(f"{path} does not open as tensors alone: {why}; fetch it again, or re-save its state dicts alone") from error
    except (OSError, MemoryError):
        raise
    except Exception as error:
        # torch runs a pickle as a program, which damaged bytes end in any way: by an empty stack, an index, struct's own error
        told = str(error).strip().splitlines() if isinstance(error, RuntimeError | zipfile.BadZipFile) else []
        why = told[0].split(". ")[0] if told else "it is damaged, ends too early, or is something else"
        raise ValueError(f"{path} is not a valid checkpoint ({why}); fetch it again") from error
    if not isinstance(state, Mapping):
        raise ValueError(f"{path} holds a {type(state).__name__}, not tensors by name; give {KNOWN}")
    return _named(state)


def _named(state: Mapping) -> dict[str, Any]:
    """With names that are text: foreign files have numbers, too, which are then refused as unknown like any other."""
    return {str(name): value for name, value in state.items()}
