"""Difix: the same as diffusers' own classes with the release's skips, adapters and mixed views hung on them."""

import json

import made_public as made
import pytest
import torch
from torch.nn import functional as F

from enhance import Enhancer
from enhance.checkpoints import open_public, read_state
from enhance.public.clip_text import encoded, tokens
from enhance.public.difix import ALPHA


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    return made.difix(tmp_path_factory.mktemp("difix") / "difix")


@pytest.fixture(scope="module")
def enhancer(release):
    return Enhancer.load(release[0], bfloat16=False)


def picture(h=64, w=128, seed=0):
    return torch.rand(h, w, 3, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def unmodified(release, text, frame, reference=None):
    """The release's chain on diffusers' modules: adapters beside the weights, skips and mixed views by hooks, diffusers' scheduler."""
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

    folder, unet, vae = release
    adapters, seen, hooks = made.adapted(vae), [], []
    for name, layer in vae.named_modules():
        if f"{name}.lora_A.vae_skip.weight" in adapters:
            down, up = (adapters[f"{name}.lora_{side}.vae_skip.weight"] for side in "AB")

            def beside(module, x, out, down=down, up=up):
                if down.ndim == 2:
                    return out + ALPHA / made.RANK * F.linear(F.linear(x[0], down), up)
                return out + ALPHA / made.RANK * F.conv2d(F.conv2d(x[0], down, padding=module.padding), up)

            hooks.append(layer.register_forward_hook(beside))
    for block in vae.encoder.down_blocks:
        hooks.append(block.register_forward_pre_hook(lambda _module, x: seen.append(x[0])))
    for i, block in enumerate(vae.decoder.up_blocks):
        skip = getattr(vae.decoder, f"skip_conv_{i + 1}")
        hooks.append(block.register_forward_pre_hook(lambda _m, x, skip=skip, i=i: (x[0] + skip(seen[-1 - i][:1]), *x[1:])))
    for name, layer in unet.named_modules():
        if name.endswith("attn1") and reference is not None:
            hooks.append(layer.register_forward_pre_hook(lambda _m, x: (x[0].reshape(1, -1, x[0].shape[-1]),)))
            hooks.append(layer.register_forward_hook(lambda _m, _x, out: out.reshape(2, -1, out.shape[-1])))
    views = torch.stack([frame] if reference is None else [frame, reference]).permute(0, 3, 1, 2) * 2 - 1
    scheduler = DDPMScheduler.from_config(json.loads((folder / "scheduler" / "scheduler_config.json").read_text()))
    scheduler.set_timesteps(timesteps=[199])
    z = vae.encode(views).latent_dist.mode() * vae.config.scaling_factor
    noise = unet(z, torch.tensor(199), encoder_hidden_states=text.expand(len(views), -1, -1)).sample
    clean = scheduler.step(noise, 199, z).prev_sample[:1]
    out = vae.decode(clean / vae.config.scaling_factor).sample[0]
    for hook in hooks:
        hook.remove()
    return (out / 2 + 0.5).clamp(0, 1).permute(1, 2, 0)


def test_one_frame_is_the_unmodified_graphs(release, enhancer):
    better, memory = enhancer.step(picture())
    whole = unmodified(release, enhancer.model.text, picture())
    assert whole.std() > 0.02 and torch.allclose(better, whole, atol=1e-4)
    assert torch.equal(enhancer.step(picture(), memory)[0], better)


def test_a_reference_view_is_mixed_in(release, enhancer):
    clean = picture(seed=5)
    with_reference = Enhancer.load(release[0], bfloat16=False, reference=clean)
    better, _ = with_reference.step(picture())
    assert torch.allclose(better, unmodified(release, enhancer.model.text, picture(), clean), atol=1e-4)
    assert not torch.allclose(better, enhancer.step(picture())[0], atol=1e-3)


def test_odd_sizes_are_padded_to_what_the_unet_halves(release, enhancer):
    rgb = picture(50, 70)
    padded = rgb[torch.arange(64).clamp(max=49)][:, torch.arange(128).clamp(max=69)]
    assert torch.allclose(enhancer.step(rgb)[0], unmodified(release, enhancer.model.text, padded)[:50, :70], atol=1e-4)


def test_the_prompt_is_split_as_clip_does(release):
    ids = tokens(release[0] / "tokenizer", "remove degradation", 77)[0].tolist()
    assert ids[:5] == [1, 3, 4, 5, 2] and set(ids[5:]) == {0} and len(ids) == 77


def test_text_looks_at_earlier_words_only(release):
    file = release[0] / "text_encoder" / "model.safetensors"
    config = json.loads((release[0] / "text_encoder" / "config.json").read_text())
    first = encoded(file, read_state(file), config, torch.tensor([[1, 3, 4, 5, 2]]))
    second = encoded(file, read_state(file), config, torch.tensor([[1, 3, 4, 6, 2]]))
    assert torch.equal(first[:, :3], second[:, :3]) and not torch.allclose(first[:, 3:], second[:, 3:])


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        ("unet/config.json", {"block_out_channels": [16, 32, 32]}, "UNet2DConditionModel"),
        ("unet/config.json", {"cross_attention_dim": 20}, "to_k.weight of Difix's UNet has shape"),
        ("scheduler/scheduler_config.json", {"prediction_type": "v_prediction"}, "v_prediction"),
        ("tokenizer/vocab.json", {"remove</w>": None}, "tokenizer"),
        ("text_encoder/config.json", {"intermediate_size": 7}, "fc1"),
        ("text_encoder/config.json", {"intermediate_size": None}, "config.json does not say intermediate_size"),
        ("text_encoder/config.json", {"num_attention_heads": 5}, "in 5 heads"),
        ("text_encoder/config.json", {"hidden_act": "relu"}, "the activation 'relu'"),
        ("vae/config.json", {"scaling_factor": None}, "config.json does not say scaling_factor"),
        ("scheduler/scheduler_config.json", {"beta_start": None}, "scheduler_config.json does not say beta_start"),
        ("scheduler/scheduler_config.json", {"num_train_timesteps": 100}, "num_train_timesteps is 100, and the release runs at step 199"),
    ],
)
def test_a_folder_that_is_not_whole_is_refused(release, tmp_path, file, change, says):
    import shutil

    shutil.copytree(release[0], tmp_path / "difix")
    path = tmp_path / "difix" / file
    found = {name: value for name, value in (json.loads(path.read_text()) | change).items() if value is not None}
    path.write_text(json.dumps(found))
    with pytest.raises(ValueError, match=says):
        open_public(tmp_path / "difix")


def test_an_adapter_without_its_weight_is_refused(release, tmp_path):
    import shutil

    from safetensors.torch import load_file, save_file

    shutil.copytree(release[0], tmp_path / "difix")
    file = tmp_path / "difix" / "vae" / "diffusion_pytorch_model.safetensors"
    state = load_file(file)
    del state["decoder.conv_in.lora_B.vae_skip.weight"]
    save_file(state, file)
    with pytest.raises(ValueError, match="lora_A.vae_skip.weight stands alone"):
        open_public(tmp_path / "difix")
