"""Ke et al.'s Harmonizer: six filters, what predicts their arguments, and where they are applied."""

import kornia
import pytest
import torch
from torch.nn import functional as F

from enhance import Enhancer
from enhance.checkpoints import open_public
from enhance.public.filters import FILTERS, brightness, contrast, harmonized, highlight, saturation, shadow, temperature
from enhance.public.white_box import Same, WhiteBox
from render.frame_types import Frame
from scenes.camera import Camera
from scenes.lenses import Pinhole


def picture(*size, seed=0):
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed))


IMAGES = picture(2, 3, 12, 16)


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """A `harmonizer.pth` of random weights, and the network that it holds."""
    torch.manual_seed(0)
    net = WhiteBox()
    for layer in net.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.running_mean.normal_(0, 0.1)
            layer.running_var.uniform_(0.5, 1.5)
    path = tmp_path_factory.mktemp("ke") / "harmonizer.pth"
    torch.save(net.state_dict(), path)
    return path, net.eval()


def frame(rgb, instance=None):
    h, w = rgb.shape[:2]
    return Frame(Camera(Pinhole(50.0, 50.0, w / 2, h / 2), w, h, torch.eye(4, dtype=torch.float64)), rgb=rgb, instance=instance)


@pytest.mark.parametrize("change", FILTERS)
def test_an_argument_of_0_leaves_a_picture_as_it_is(change):
    assert torch.allclose(change(IMAGES, torch.zeros(2)), IMAGES, atol=1e-5)


@pytest.mark.parametrize("change", FILTERS)
@pytest.mark.parametrize("x", [-1.0, -0.3, 0.4, 1.0])
def test_filters_stay_in_the_display_and_treat_each_image_by_itself(change, x):
    both = change(IMAGES, torch.tensor([x, 0.2]))
    assert both.min() >= 0 and both.max() <= 1 and torch.isfinite(both).all()
    assert torch.allclose(both[:1], change(IMAGES[:1], torch.tensor([x])), atol=1e-6)


@pytest.mark.parametrize("x", [-0.5, 0.3])
def test_brightness_scales_the_value_of_hsv(x):
    h, s, v = kornia.color.rgb_to_hsv(IMAGES).unbind(1)
    scale = 1 + x if x < 0 else 1 / (1 - x)
    whole = kornia.color.hsv_to_rgb(torch.stack([h, s, v * scale], 1)).clamp(0, 1)
    assert torch.allclose(brightness(IMAGES, torch.full((2,), x)), whole, atol=1e-4)


def test_filters_do_what_they_are_named_for():
    up, down = torch.full((2,), 0.3), torch.full((2,), -0.3)
    assert contrast(IMAGES, up).std() > IMAGES.std() > contrast(IMAGES, down).std()
    spread = [(x.amax(1) - x.amin(1)).mean() for x in (saturation(IMAGES, down), IMAGES, saturation(IMAGES, up))]
    assert spread[0] < spread[1] < spread[2]
    warmth = [(x[:, 0] - x[:, 2]).mean() for x in (temperature(IMAGES, down), IMAGES, temperature(IMAGES, up))]
    assert warmth[0] < warmth[1] < warmth[2]
    dark, light = torch.full_like(IMAGES, 0.1), torch.full_like(IMAGES, 0.9)
    assert (shadow(dark, up) - dark).mean() > (shadow(light, up) - light).mean() > 0
    assert (highlight(light, down) - light).mean() < (highlight(dark, down) - dark).mean() < 0


def test_only_the_mask_is_changed():
    mask = torch.zeros(2, 1, 12, 16)
    mask[..., 3:9, 4:] = 1
    out = harmonized(IMAGES, mask, [torch.full((2,), 0.3)] * 6)
    assert torch.equal(torch.where(mask > 0, IMAGES, out), IMAGES) and not torch.allclose(out, IMAGES, atol=0.05)


@pytest.mark.parametrize(("kernel", "stride", "side"), [(3, 1, 9), (3, 2, 10), (5, 2, 8), (5, 1, 6)])
def test_padding_is_tensorflows_same(kernel, stride, side):
    conv, x = Same(1, 1, kernel, stride, bias=False), picture(1, 1, side, side)
    spare = max((-(-side // stride) - 1) * stride + kernel - side, 0)
    padded = F.pad(x, (spare // 2, spare - spare // 2, spare // 2, spare - spare // 2))
    assert torch.equal(conv(x), F.conv2d(padded, conv.weight, stride=stride)) and conv(x).shape[-1] == -(-side // stride)


def test_the_layout_is_efficientnet_b0s_with_two_stems(release):
    names = torch.load(release[0]).keys()
    blocks = {name.split(".")[2] for name in names if name.startswith("backbone._blocks.")}
    assert blocks == {str(i) for i in range(16)}
    assert {"backbone._conv_fg.weight", "backbone._bn_bg.running_var", "backbone._conv_head.weight", "backbone._bn1.bias"} <= names
    assert {"backbone._blocks.0._depthwise_conv.weight", "backbone._blocks.15._se_expand.bias"} <= names
    assert "backbone._blocks.0._expand_conv.weight" not in names and "regressor.headers.5.1.weight" in names
    backbone = sum(p.numel() for name, p in release[1].named_parameters() if name.startswith("backbone."))
    assert backbone == 5_288_548 - 1000 * 1281 - 864 + 2 * 16 * 4 * 9  # B0 without classes; two stems of 4 channels for one of 3


def test_objects_are_harmonized_and_arguments_follow_slowly(release):
    path, net = release
    enhancer, rgb, instance = Enhancer.load(path), picture(40, 60, 3), torch.full((40, 60), -1, dtype=torch.int32)
    plain, memory = enhancer.step(rgb)
    assert torch.equal(plain, rgb) and memory is None
    instance[10:30, 20:50] = 2
    better, memory = enhancer.step(frame(rgb, instance))
    image, mask = rgb.permute(2, 0, 1)[None], (instance > 0).float()[None, None]
    with torch.no_grad():
        now = net(image, mask)
        assert torch.allclose(better, harmonized(image, mask, now)[0].permute(1, 2, 0), atol=1e-6)
        later, cut = net(0.9 * image, mask), net(1 - image, mask)
    assert torch.equal(better[instance < 0], rgb[instance < 0])
    _, after = enhancer.step(frame(0.9 * rgb, instance), memory)
    assert torch.allclose(after.mean, 0.96 * memory.mean + 0.04 * torch.cat(later), atol=1e-6)
    assert torch.allclose(enhancer.step(frame(1 - rgb, instance), after)[1].mean, torch.cat(cut), atol=1e-6), "another place begins anew"


def test_another_layout_is_refused_by_name(release, tmp_path):
    state = torch.load(release[0])
    state["regressor.headers.6.0.weight"] = torch.zeros(2)
    torch.save(state, tmp_path / "harmonizer.pth")
    with pytest.raises(ValueError, match=r"unknown regressor\.headers\.6\.0\.weight of Harmonizer of Ke et al\."):
        open_public(tmp_path / "harmonizer.pth")
