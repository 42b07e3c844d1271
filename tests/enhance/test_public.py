"""The public models: read strictly, and the same as their unmodified graphs."""

import io
import pickle
import random
import warnings

import made_public as made
import pytest
import torch

from enhance import Enhancer
from enhance.checkpoints import open_public, read_state
from enhance.public.cosmos import Denoiser
from enhance.public.enhancer import PublicEnhancer
from enhance.public.model import Model
from enhance.public.wan import MEAN, STD, Autoencoder

ROUNDING = 2e-5
"""Of float32 through some thirty layers of sums over some hundred terms, taken in another order; 1e-6 to 6e-6 was seen."""


@pytest.fixture(scope="module")
def nets():
    return made.cosmos(1), made.wan(2)


@pytest.fixture(scope="module")
def harmonizer(nets, tmp_path_factory):
    return made.harmonizer(tmp_path_factory.mktemp("harmonizer") / "diffusion_harmonizer.pkl", *nets)


def picture(h=32, w=48, seed=0):
    return torch.rand(h, w, 3, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def unmodified(nets, clip, sigma=0.25):
    """The release's chain of whole graphs: `[V, H, W, 3]` in 0..1 to V frames, text of zeros, padding mask and all."""
    net, vae = nets
    mean, std = (torch.tensor(v).view(1, 16, 1, 1, 1) for v in (MEAN, STD))
    z = (vae.encode(clip.permute(3, 0, 1, 2)[None] * 2 - 1).latent_dist.mode() - mean) / std
    t = sigma / (1 + sigma)
    x = torch.cat([(1 - t) * z, torch.zeros_like(z[:, :1])], 1)
    clean = (1 - t) * z - t * net(x, torch.tensor([t]), torch.zeros(1, 512, net.config.text_embed_dim)).sample
    return (vae.decode(clean * std + mean).sample[0] / 2 + 0.5).permute(1, 2, 3, 0).clamp(0, 1)


def test_a_release_of_the_real_depth_has_as_many_tensors_as_its_authors_count(nets):
    state = made.transformer_state(nets[0])
    blocks = sum(name.startswith("blocks.") for name in state)
    assert blocks == 2 * 20 and len(state) - blocks + 20 * 20 == 414  # "the dit_ema.* keys (~414)", NVIDIA/harmonizer
    assert len(made.autoencoder_state(nets[1])) == 194  # of Wan2.1_VAE.pth


@pytest.mark.parametrize("masks", [1, 2])
def test_the_folded_transformer_is_the_whole_one(tmp_path, masks):
    net = made.cosmos(3, masks)
    z = torch.randn(1, 16, 2, 6, 10, generator=torch.Generator().manual_seed(0))
    folded = Denoiser.read(tmp_path, made.transformer_state(net), sigma=0.25)
    with torch.no_grad():
        x = torch.cat([0.8 * z, torch.zeros(1, masks, 2, 6, 10)], 1)
        whole = 0.8 * z - 0.2 * net(x, torch.tensor([0.2]), torch.zeros(1, 7, 20)).sample
        assert (whole - 0.8 * z).abs().mean() > 0.1
        assert torch.allclose(folded(z), whole, atol=ROUNDING)


def test_text_of_zeros_adds_nothing_and_other_text_does(nets):
    net = nets[0]
    x, t = torch.randn(1, 17, 1, 4, 4, generator=torch.Generator().manual_seed(0)), torch.tensor([0.2])
    with torch.no_grad():
        nothing = net(x, t, torch.zeros(1, 512, 20)).sample
        for block in net.transformer_blocks:
            assert not block.attn2(torch.randn(1, 4, 48), torch.zeros(1, 512, 20)).any()
        assert not torch.allclose(nothing, net(x, t, torch.ones(1, 512, 20)).sample, atol=1e-3)


@pytest.mark.parametrize("frames", [1, 5])
def test_the_autoencoder_is_the_whole_one_and_decodes_the_first_frame_alone(nets, tmp_path, frames):
    vae = nets[1]
    ours = Autoencoder.read(tmp_path, made.autoencoder_state(vae))
    clip = torch.rand(1, 3, frames, 24, 40, generator=torch.Generator().manual_seed(0)) * 2 - 1
    mean, std = (torch.tensor(v).view(1, 16, 1, 1, 1) for v in (MEAN, STD))
    with torch.no_grad():
        latents, features = ours.encode(clip)
        whole = vae.encode(clip).latent_dist.mode()
        assert latents.shape[2] == (frames + 3) // 4
        assert torch.allclose(latents * std + mean, whole, atol=ROUNDING)
        assert torch.allclose(ours.decode(latents, features), vae._decode(whole).sample[:, :, 0], atol=ROUNDING)


def test_an_autoencoder_of_single_frames_loses_nothing(nets, tmp_path):
    state = made.autoencoder_state(nets[1])
    clip = torch.rand(1, 3, 1, 16, 16) * 2 - 1
    whole, single = Autoencoder.read(tmp_path, state), Autoencoder.read(tmp_path, state, single=True)
    assert torch.equal(whole.encode(clip)[0], single.encode(clip)[0])
    assert 2.5 * sum(p.numel() for p in single.encoder.parameters()) < sum(p.numel() for p in whole.encoder.parameters())


def test_skips_carry_the_encoders_features_to_where_the_release_adds_them(nets, tmp_path):
    vae, draw = nets[1], torch.Generator().manual_seed(0)
    widths = [32, 32, 32, 32, 32, 16, 16, 8, 8]
    carry = [0.3 * torch.randn(w, w, 1, 1, 1, generator=draw) for w in widths]
    state = made.autoencoder_state(vae) | {f"decoder.skip_conv_{i}.weight": w for i, w in enumerate(carry)}
    clip, seen, hooks = torch.rand(1, 3, 1, 16, 32, generator=draw) * 2 - 1, [], []
    for block in vae.encoder.down_blocks:
        hooks.append(block.register_forward_hook(lambda _module, _x, out: seen.append(out)))
    # decoder layer 4 b + r is residual block r of stage b; the numbers are `enc_dec_mapping` of NVIDIA/harmonizer
    for i, (layer, back) in enumerate({0: 0, 1: 1, 2: 2, 5: 3, 6: 4, 8: 6, 10: 7, 12: 9, 14: 10}.items()):
        block = vae.decoder.up_blocks[layer // 4].resnets[layer % 4]
        add = lambda _module, x, i=i, back=back: (x[0] + torch.nn.functional.conv3d(seen[::-1][back], carry[i]), *x[1:])  # noqa: E731
        hooks.append(block.register_forward_pre_hook(add))
    with torch.no_grad():
        latents = vae.encode(clip).latent_dist.mode()
        whole = vae._decode(latents).sample[:, :, 0]
        for hook in hooks:
            hook.remove()
        ours = Autoencoder.read(tmp_path, state, single=True)
        assert torch.allclose(ours.decode(*ours.encode(clip)).clamp(-1, 1), whole, atol=ROUNDING)
        assert not torch.allclose(vae._decode(latents).sample[:, :, 0], whole, atol=1e-2)


def test_harmonizer_runs_as_its_release_does_alone_and_with_four_results(nets, harmonizer):
    enhancer, memory, results = Enhancer.load(harmonizer, bfloat16=False), None, []
    for i in range(6):
        frame = (picture() + 0.02 * i).clamp(0, 1)
        better, memory = enhancer.step(frame, memory)
        past = results[::-1][:4] if len(results) >= 4 else []
        assert torch.allclose(better, unmodified(nets, torch.stack([frame, *past]))[0], atol=1e-4), i
        assert not torch.allclose(better, frame, atol=0.05)
        results.append(better)
    alone, _ = enhancer.step(frame)
    assert not torch.allclose(alone, better, atol=1e-3)


def test_what_is_of_no_use_is_left_out_and_said(harmonizer):
    about = Enhancer.load(harmonizer).about
    assert about["left out"] == ["net_disc", "optimizer", "optimizer_disc", "net_ema.*"]


def test_history_can_be_left_out(harmonizer):
    enhancer, memory = Enhancer.load(harmonizer, bfloat16=False, history=0), None
    for _ in range(6):
        better, memory = enhancer.step(picture(), memory)
    assert torch.equal(better, enhancer.step(picture())[0])
    with pytest.raises(ValueError, match="0 or 4"):
        Enhancer.load(harmonizer, history=2)


def test_a_cut_and_a_change_of_size_forget(harmonizer):
    enhancer, memory = Enhancer.load(harmonizer, bfloat16=False), None
    for _ in range(4):
        _, memory = enhancer.step(picture(), memory)
    assert len(memory.frames) == 4
    cut = 0.3 * picture(seed=5) + 0.7 * torch.linspace(0, 1, 48)[:, None]
    assert len(enhancer.step(cut, memory)[1].frames) == 1
    other = picture(16, 16)
    better, after = enhancer.step(other, memory)
    assert len(after.frames) == 1 and torch.equal(better, enhancer.step(other)[0])


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (16, 32), (33, 17)])
def test_any_size_is_padded_and_cut_back(nets, harmonizer, size):
    rgb = picture(*size)
    better, _ = Enhancer.load(harmonizer, bfloat16=False).step(rgb)
    height, width = (-(-n // 16) * 16 for n in size)
    padded = rgb[torch.arange(height).clamp(max=size[0] - 1)][:, torch.arange(width).clamp(max=size[1] - 1)]
    assert torch.allclose(better, unmodified(nets, padded[None])[0][: size[0], : size[1]], atol=1e-4)


def test_bfloat16_is_near(harmonizer):
    exact, _ = Enhancer.load(harmonizer, bfloat16=False).step(picture())
    near, _ = Enhancer.load(harmonizer, bfloat16=True).step(picture())
    assert near.dtype == torch.float32 and (near - exact).abs().mean() < 0.01


def test_the_folder_of_the_base_loads(nets, tmp_path):
    enhancer = Enhancer.load(made.base(tmp_path / "base", *nets), bfloat16=False)
    assert enhancer.about["model"] == "Cosmos-Predict2" and enhancer.history == 0
    assert torch.allclose(enhancer.step(picture())[0], unmodified(nets, picture()[None])[0], atol=1e-4)


@pytest.fixture
def parts(nets):
    unet = made.prefixed("dit.", made.transformer_state(nets[0]))
    return {"state_dict_unet": unet, "state_dict_vae": made.autoencoder_state(nets[1]), "optimizer": {}}


def broken(parts, tmp_path, match):
    torch.save(parts, tmp_path / "x.pkl")
    with pytest.raises(ValueError, match=match) as found:
        open_public(tmp_path / "x.pkl")
    assert str(tmp_path / "x.pkl") in str(found.value)


def test_what_is_missing_unknown_or_misshapen_is_named(parts, tmp_path):
    unet, vae = parts["state_dict_unet"], parts["state_dict_vae"]
    name = "blocks.1.cross_attn.output_proj.weight"
    kept = unet.pop(f"dit.{name}")
    broken(parts, tmp_path, f"lacks {name} of Cosmos-Predict2, which has 47 tensors; fetch")
    unet[f"dit.{name}"] = kept.T[:3]
    broken(parts, tmp_path, rf"{name} of Cosmos-Predict2 has shape \(3, 48\), wanted \(48, 48\)")
    unet[f"dit.{name}"] = kept.int()
    broken(parts, tmp_path, "floats, got torch.int32")
    unet[f"dit.{name}"] = kept
    unet["controlnet.weight"] = kept
    broken(parts, tmp_path, "unknown controlnet.weight")
    del unet["controlnet.weight"]
    broken(parts | {"state_dict_controlnet": {"weight": kept}}, tmp_path, "unknown part state_dict_controlnet")
    vae["decoder.middle.3.gamma"] = kept
    broken(parts, tmp_path, "unknown decoder.middle.3.gamma of the Wan 2.1 autoencoder")
    del vae["decoder.middle.3.gamma"]
    vae["encoder.conv1.bias"] = vae["encoder.conv1.bias"] * torch.nan
    broken(parts, tmp_path, "encoder.conv1.bias holds values that are not finite")


def test_damage_that_leads_the_unpickler_astray_is_refused(tmp_path):
    """Bytes of a stack machine: what is popped from an empty stack, or asked of a memo that has nothing, is no ValueError of its own."""
    damaged, whole = tmp_path / "a.pkl", io.BytesIO()
    torch.save({"a": torch.rand(3, 4)}, whole, _use_new_zipfile_serialization=False)
    draw = random.Random(0)
    kinds = set()
    for _ in range(200):
        data = bytearray(whole.getvalue())
        data[draw.randrange(80)] = draw.randrange(256)
        damaged.write_bytes(draw.choice([data, b"\x80\x02" + bytes(draw.choices(b"}]q(.KXuabeslt)0N\x85\x86R", k=12))]))
        try:
            read_state(damaged)
        except ValueError as error:
            assert str(error).startswith(str(damaged)), error
            kinds.add(type(error.__cause__))
    assert IndexError in kinds


def test_a_file_that_is_cut_off_foreign_or_would_run_code_is_refused(harmonizer, tmp_path):
    whole = harmonizer.read_bytes()
    cut = tmp_path / "cut.pkl"
    for length in (0, 10, len(whole) // 2, len(whole) - 30):
        cut.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="cut.pkl"):
            open_public(cut)
    cut.write_text("<html>Access to this model is restricted</html>")
    with pytest.raises(ValueError, match="cut.pkl"):
        open_public(cut)
    cut.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(ValueError, match="cut.pkl is not the file itself but Git LFS's pointer.* git lfs pull"):
        open_public(cut)
    cut.write_bytes(pickle.dumps(print))  # in a protocol that torch warns of
    with warnings.catch_warnings(action="error"), pytest.raises(ValueError, match="cut.pkl does not open as tensors alone"):
        open_public(cut)
    torch.save({"state_dict_unet": print}, cut)
    with pytest.raises(ValueError, match="print") as refused:
        read_state(cut)
    assert "safe_globals" not in str(refused.value)  # no advice to run it
    torch.save({"layer.weight": torch.zeros(2)}, cut)
    with pytest.raises(ValueError, match=r"layer\.weight; give NVIDIA Harmonizer"):
        Enhancer.load(cut)
    for vae in ("conv1.weight", 7):
        torch.save({"state_dict_unet": {7: torch.zeros(2)}, "state_dict_vae": {vae: torch.zeros(2)}}, cut)
        with pytest.raises(ValueError, match=r"cut\.pkl"):
            open_public(cut)
    torch.save([torch.zeros(2)], cut)
    with pytest.raises(ValueError, match="holds a list"):
        open_public(cut)
    with pytest.raises(ValueError, match="holds no known model"):
        Enhancer.load(tmp_path)
    (tmp_path / "enhancer.safetensors").touch()
    with pytest.raises(ValueError, match=r"folder of a training; give .*enhancer\.safetensors"):
        Enhancer.load(tmp_path)
    with pytest.raises(FileNotFoundError, match="fetch a public model"):
        Enhancer.load(tmp_path / "none.pkl")


def test_half_a_model_says_where_the_other_half_belongs(nets, tmp_path):
    folder = made.base(tmp_path / "base", *nets)
    with pytest.raises(ValueError, match=r"give its folder, with tokenizer/tokenizer\.pth"):
        open_public(folder / "model.pt")
    with pytest.raises(ValueError, match="autoencoder alone"):
        open_public(folder / "tokenizer" / "tokenizer.pth")


def test_the_folders_of_diffusers_load_as_the_releases_do(nets, tmp_path):
    import json

    from safetensors.torch import save_file

    net, vae = nets
    weight = net.state_dict()["patch_embed.proj.weight"]
    assert weight.shape[1] == 17 * 4  # as diffusers has it too, where it makes the mask channel itself
    config = {"_class_name": "CosmosTransformer3DModel", "in_channels": 16, "extra_pos_embed_type": None, "rope_scale": [1.0, 4.0, 4.0]}
    for name, module in (("transformer", net), ("vae", vae)):
        (tmp_path / name).mkdir()
        save_file(module.state_dict(), tmp_path / name / "diffusion_pytorch_model.safetensors")
    with pytest.raises(ValueError, match="no known model"):
        open_public(tmp_path)
    (tmp_path / "transformer" / "config.json").write_text(json.dumps(config | {"rope_scale": [1.0, 3.0, 3.0]}))
    with pytest.raises(ValueError, match=r"rope_scale is \[1.0, 3.0, 3.0\]"):
        open_public(tmp_path)
    (tmp_path / "transformer" / "config.json").write_text(json.dumps(config))
    better, _ = Enhancer.load(tmp_path, bfloat16=False).step(picture())
    assert torch.allclose(better, unmodified(nets, picture()[None])[0], atol=1e-4)


class Half(torch.nn.Module):
    """A tokenizer's half that shrinks or grows by 8."""

    def __init__(self, inputs: int, outputs: int, scale: float):
        super().__init__()
        self.conv = torch.nn.Conv2d(inputs, outputs, 1)
        self.scale = scale

    def forward(self, x):
        return self.conv(torch.nn.functional.interpolate(x, scale_factor=self.scale, mode="nearest"))


@pytest.fixture
def fixer(nets, tmp_path):
    """The folders of nvidia/Fixer: its tensors, and its tokenizer's graph with weights from before it was trained further."""
    torch.manual_seed(0)
    trained = {"encoder": Half(3, 16, 0.125), "decoder": Half(16, 3, 8.0)}
    statistics = [torch.randn(16), 1 + torch.rand(16)]
    for name in ("base", "pretrained"):
        (tmp_path / name).mkdir()
    graphs = {}
    for name, half in {"encoder": Half(3, 16, 0.125), "decoder": Half(16, 3, 8.0)}.items():
        torch.jit.save(torch.jit.script(half), buffer := io.BytesIO())
        graphs[name] = buffer.getvalue()
    torch.save(graphs | {"mean_std": statistics}, tmp_path / "base" / "tokenizer_fast.pth")
    vae = {f"{name}.{key}": value for name, half in trained.items() for key, value in half.state_dict().items()}
    unet = made.prefixed("dit.", made.transformer_state(nets[0])) | made.prefixed("tokenizer.", vae)
    path = tmp_path / "pretrained" / "pretrained_fixer.pkl"
    torch.save({"state_dict_unet": unet, "state_dict_vae": vae, "net_disc": {}, "optimizer": {}, "optimizer_disc": {}}, path)
    return path, trained, statistics


@torch.no_grad()
def test_fixer_runs_its_trained_tokenizer_and_the_whole_transformer(nets, fixer):
    path, halves, (mean, std) = fixer
    mean, std = mean.view(1, 16, 1, 1), std.view(1, 16, 1, 1)
    z = (halves["encoder"](picture().permute(2, 0, 1)[None] * 2 - 1) - mean) / std
    x = torch.cat([0.8 * z, torch.zeros_like(z[:, :1])], 1)[:, :, None]
    clean = 0.8 * z - 0.2 * nets[0](x, torch.tensor([0.2]), torch.zeros(1, 512, 20)).sample[:, :, 0]
    whole = (halves["decoder"](clean * std + mean)[0] / 2 + 0.5).permute(1, 2, 0).clamp(0, 1)
    assert torch.allclose(Enhancer.load(path, bfloat16=False).step(picture())[0], whole, atol=1e-5)


def test_a_fixer_says_where_its_tokenizer_belongs_and_what_is_wrong_with_it(fixer):
    path = fixer[0]
    tokenizer = path.parents[1] / "base" / "tokenizer_fast.pth"
    kept = torch.load(tokenizer)  # read_state maps the file, which is written over here
    torch.save(kept | {"encoder": kept["encoder"][:100]}, tokenizer)
    with pytest.raises(ValueError, match="encoder is not a valid TorchScript"):
        open_public(path)
    torch.save({"encoder": kept["encoder"]}, tokenizer)
    with pytest.raises(ValueError, match="holds encoder, not encoder, decoder, mean_std"):
        open_public(path)
    tokenizer.unlink()
    with pytest.raises(ValueError, match="base/tokenizer_fast.pth of nvidia/Fixer"):
        open_public(path)


class Exported(torch.nn.Module):
    def forward(self, x):
        assert x.shape[2] == 576 and x.shape[3] == 1024
        return -x


@pytest.mark.parametrize("size", [(20, 30), (576, 1024), (600, 1100)])
def test_torchscript_is_given_the_size_that_it_was_exported_for(tmp_path, size):
    torch.jit.save(torch.jit.script(Exported()), tmp_path / "harmonizer_nontemporal.pt")
    rgb = picture(*size)
    assert torch.allclose(Enhancer.load(tmp_path / "harmonizer_nontemporal.pt", bfloat16=False).step(rgb)[0], 1 - rgb, atol=1e-6)


def test_torchscript_that_does_not_run_or_is_cut_off_is_refused(tmp_path):
    class Half4(torch.nn.Module):
        def forward(self, x):
            return x[..., ::2]

    class Lost(torch.nn.Module):
        def forward(self, x):
            return x / 0

    path = tmp_path / "harmonizer_nontemporal.pt"
    torch.jit.save(torch.jit.script(Half4()), path)
    with pytest.raises(ValueError, match="use the .pkl"):
        Enhancer.load(path, bfloat16=False).step(picture())
    torch.jit.save(torch.jit.script(Lost()), path)
    with pytest.raises(ValueError, match=r"harmonizer_nontemporal\.pt makes values that are not finite"):
        Enhancer.load(path, bfloat16=False).step(picture())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match="fetch it again"):
        open_public(path)


def test_torchscript_of_something_else_is_refused_before_its_first_frame(tmp_path):
    class Pair(torch.nn.Module):
        def forward(self, x, y):
            return x, y

    class Mute(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(1))

    path = tmp_path / "other.pt"
    for module, said in ((Pair(), r"takes Tensor, Tensor and gives Tuple\[Tensor, Tensor\]"), (Mute(), "takes nothing and gives nothing")):
        torch.jit.save(torch.jit.script(module), path)
        with pytest.raises(ValueError, match=f"other.pt is a TorchScript that {said}, where an enhancer takes one tensor and gives one"):
            open_public(path)


class Ladder(Model):
    """Leaves pictures as they are; notes the sizes that it saw."""

    name = "ladder"

    def __init__(self):
        super().__init__()
        self.seen = set()

    def forward(self, clip):
        self.seen.add(tuple(clip.shape[-2:]))
        return clip[:, 0]


@pytest.mark.parametrize("size", [(2160, 3840), (1281, 1300), (16, 2000), (1279, 17)])
def test_larger_frames_are_worked_on_in_parts_that_meet_without_a_seam(size):
    model, rgb = Ladder(), picture(*size)
    out, _ = PublicEnhancer(model, bfloat16=False).step(rgb)
    assert torch.allclose(out, rgb, atol=1e-6)
    assert all(side % 16 == 0 and side <= 1280 for shape in model.seen for side in shape)


def test_what_is_no_picture_is_refused(harmonizer):
    enhancer = Enhancer.load(harmonizer, bfloat16=False)
    rgb = picture()
    rgb[4, 7, 1] = torch.nan
    with pytest.raises(ValueError, match="row 4, column 7"):
        enhancer.step(rgb)
    with pytest.raises(ValueError, match="takes no reference"):
        Enhancer.load(harmonizer, reference=picture())


def test_what_is_drawn_on_a_result_is_not_remembered(harmonizer):
    better, memory = Enhancer.load(harmonizer, bfloat16=False).step(picture())
    before = better.clone()
    better[:4] = 0
    assert torch.equal(memory.frames[0], before)


def test_a_huge_model_says_so_before_it_begins(harmonizer, monkeypatch, capsys):
    from enhance.clip import load_saying

    load_saying(str(harmonizer))
    assert not capsys.readouterr().err
    monkeypatch.setattr("enhance.clip.HUGE", 10_000)
    load_saying(str(harmonizer))
    said = capsys.readouterr().err
    assert "NVIDIA Harmonizer" in said and "million weights" in said and "--weights builtin" in said


def test_nothing_is_rendered_for_a_model_that_looks_at_pictures_only(harmonizer):
    from enhance.clip import enhancement

    stages, outputs = enhancement(str(harmonizer), references=object())  # photos that it would not look at are not looked up
    assert list(stages) == ["enhance"] and outputs == () and "instance" in Enhancer.load("builtin").reads


def test_a_clip_is_enhanced_by_any_of_them(harmonizer, tmp_path):
    from enhance import enhance_video
    from render.video import VideoWriter, read_video

    with VideoWriter(tmp_path / "clip.mp4", 10, 48, 32) as writer:
        for i in range(3):
            writer.write(picture() * (1 - 0.02 * i))
    assert enhance_video(tmp_path / "clip.mp4", tmp_path / "clean.mp4", Enhancer.load(harmonizer)) == (3, 3)
    assert [tuple(rgb.shape) for rgb in read_video(tmp_path / "clean.mp4")] == 3 * [(32, 48, 3)]
