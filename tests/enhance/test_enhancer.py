"""The enhancer as it is called."""

from dataclasses import replace

import pytest
import torch
from small_net import SMALL, stirred

from enhance.enhancer import Enhancer
from enhance.network.net import Net
from enhance.network.weights_file import BUILTIN, FORMAT, REPAIR_GAIN, WORTH, load_net, save_net
from render.frame_types import Frame
from scenes.camera import Camera
from scenes.lenses import Pinhole


@pytest.fixture(scope="module")
def enhancer():
    return Enhancer(stirred())


def frame(rgb, **more):
    h, w = rgb.shape[:2]
    return Frame(Camera(Pinhole(50.0, 50.0, w / 2, h / 2), w, h, torch.eye(4, dtype=torch.float64)), rgb=rgb, **more)


def picture(h=32, w=48, seed=0):
    return torch.rand(h, w, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (16, 16), (17, 33), (37, 90)])
def test_any_size_comes_back_and_untrained_weights_are_the_identity(size):
    rgb = picture(*size)
    better, memory = Enhancer(Net(SMALL)).step(rgb)
    assert torch.equal(better, rgb) and memory.size == size
    again, memory = Enhancer(Net(SMALL)).step(rgb, memory)
    assert torch.equal(again, rgb) and memory.past.latents.shape[1] == 2


def test_memory_grows_to_four_and_no_further(enhancer):
    memory = None
    for i in range(6):
        _, memory = enhancer.step(picture(seed=i), memory)
        assert memory.past.latents.shape[1] == min(i + 1, 4)


def test_state_is_passed_and_not_hidden(enhancer):
    _, memory = enhancer.step(picture(seed=1))
    kept = memory.past.rgb.clone()
    following = picture(seed=1) * 0.9
    first, _ = enhancer.step(following, memory)
    enhancer.step(picture(seed=3))
    second, _ = enhancer.step(following, memory)
    alone, _ = enhancer.step(following)
    assert torch.equal(first, second) and torch.equal(memory.past.rgb, kept) and not torch.equal(first, alone)


def test_a_change_of_size_forgets(enhancer):
    _, memory = enhancer.step(picture())
    after, memory = enhancer.step(picture(40, 64), memory)
    assert torch.equal(after, enhancer.step(picture(40, 64))[0]) and memory.past.latents.shape[1] == 1


def test_a_frame_that_lost_its_flow_forgets(enhancer):
    _, memory = enhancer.step(frame(picture(), flow_prev=torch.zeros(32, 48, 2)))
    assert memory.flow
    after, memory = enhancer.step(frame(picture(seed=1)), memory)
    assert torch.equal(after, enhancer.step(picture(seed=1))[0]) and memory.past.latents.shape[1] == 1


def test_zero_flow_equals_an_unmoved_memory(enhancer):
    _, memory = enhancer.step(picture())
    still, _ = enhancer.step(picture() * 0.9, memory)
    moved, _ = enhancer.step(frame(picture() * 0.9, flow_prev=torch.zeros(32, 48, 2)), memory)
    assert torch.allclose(still, moved, atol=2e-3)


def test_flow_that_leaves_the_image_equals_no_memory(enhancer):
    _, memory = enhancer.step(picture())
    away, _ = enhancer.step(frame(picture() * 0.9, flow_prev=torch.full((32, 48, 2), 500.0)), memory)
    assert torch.allclose(away, enhancer.step(picture() * 0.9)[0], atol=2e-3)


def test_instances_tell_where_objects_are(enhancer):
    instance = torch.zeros(32, 48, dtype=torch.int32)
    none = enhancer.step(frame(picture(), instance=instance))[0]
    instance[8:20, 8:30] = 3
    assert not torch.equal(none, enhancer.step(frame(picture(), instance=instance))[0])


def test_values_outside_the_display_are_clamped():
    better, _ = Enhancer(Net(SMALL)).step(picture() * 3 - 1)
    assert better.min() >= 0 and better.max() <= 1


def test_a_value_that_is_not_finite_is_refused_by_place(enhancer):
    rgb = picture()
    rgb[4, 7, 1] = torch.nan
    with pytest.raises(ValueError, match="row 4, column 7"):
        enhancer.step(rgb)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (torch.zeros(32, 48), "shape"),
        (torch.zeros(32, 48, 3, dtype=torch.uint8), "255"),
        (torch.full((32, 48, 3), 90.0), "its mean is 90; divide bytes by 255"),
        (torch.zeros(0, 48, 3), "pixels"),
    ],
)
def test_what_is_no_picture_is_refused(enhancer, wrong, says):
    with pytest.raises(ValueError, match=says):
        enhancer.step(wrong)


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ({"reference": picture().mul(255).byte(), "trust": torch.ones(32, 48)}, "reference must be floats in 0..1, got torch.uint8"),
        ({"reference": picture() * 255, "trust": torch.ones(32, 48)}, "reference must be floats in 0..1, but its mean"),
        ({"reference": picture(), "trust": torch.full((32, 48), 90, dtype=torch.uint8)}, "trust must be floats in 0..1, got torch.uint8"),
        ({"instance": torch.full((32, 48), torch.nan)}, "instance must hold ids, whole numbers, got torch.float32"),
    ],
)
def test_what_is_told_in_other_numbers_is_refused(enhancer, told, says):
    with pytest.raises(ValueError, match=says):
        enhancer.step(frame(picture(), **told))


@pytest.mark.parametrize("kind", [torch.bool, torch.uint8, torch.uint16, torch.int64])
def test_ids_of_any_whole_numbers_are_the_same(enhancer, kind):
    instance = torch.zeros(32, 48, dtype=torch.int32)
    instance[8:20, 8:30] = 1
    wanted = enhancer.step(frame(picture(), instance=instance))[0]
    assert torch.equal(enhancer.step(frame(picture(), instance=instance.to(kind)))[0], wanted)


def test_what_comes_back_may_be_written_to_and_learnt_through(enhancer):
    better, memory = enhancer.step(picture().requires_grad_())
    assert not better.requires_grad and not memory.past.latents.requires_grad
    gain = torch.ones(3, requires_grad=True)
    (better * gain).sum().backward()
    better[:2] = 0
    assert torch.isfinite(gain.grad).all()


def test_flow_of_another_size_is_refused(enhancer):
    with pytest.raises(ValueError, match="flow_prev"):
        enhancer.step(frame(picture(), flow_prev=torch.zeros(3, 4, 2)))


def test_weights_survive_the_file(tmp_path):
    net = stirred()
    save_net(net, tmp_path / "w.safetensors", {"data": "none"})
    again, about = load_net(tmp_path / "w.safetensors")
    assert about == {"data": "none"} and again.config == SMALL
    for name, value in net.state_dict().items():
        assert torch.allclose(again.state_dict()[name], value, atol=1e-3), name


def test_broken_weights_say_what_is_wrong(tmp_path):
    file = tmp_path / "w.safetensors"
    save_net(stirred(), file, {})
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="not a valid safetensors file"):
        load_net(file)
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, file)
    with pytest.raises(ValueError, match="not a Sidestep enhancer"):
        load_net(file)
    with pytest.raises(FileNotFoundError, match="builtin"):
        load_net(tmp_path / "none.safetensors")


@pytest.mark.parametrize("header", [{"config": "null"}, {"config": '{"width": -8}'}, {"config": '{"looks": 3}'}, {"about": "[1]"}])
def test_a_header_that_says_nonsense_is_called_broken(tmp_path, header):
    from safetensors.torch import save_file

    file = tmp_path / "w.safetensors"
    save_file({"a": torch.zeros(1)}, file, {"format": FORMAT, "config": "{}", **header})
    with pytest.raises(ValueError, match="w.safetensors has a broken header"):
        load_net(file)


def test_weights_with_a_value_that_is_not_finite_are_refused(tmp_path):
    net = stirred()
    with torch.no_grad():
        net.age[0, 0] = torch.nan
    save_net(net, tmp_path / "w.safetensors", {})
    with pytest.raises(ValueError, match="age"):
        load_net(tmp_path / "w.safetensors")


def test_the_shipped_weights_fit_and_leave_a_grey_frame_grey():
    assert BUILTIN.stat().st_size <= 10_000_000
    enhancer = Enhancer.load("builtin")
    assert "attribution" in enhancer.about
    grey = torch.full((64, 96, 3), 0.5)
    assert (enhancer.step(grey)[0] - grey).abs().max() < 0.1


def resting(net, monkeypatch):
    """An enhancer whose training found that repairing gains too little; it fails where the network repairs all the same."""
    monkeypatch.setattr(net, "repair", lambda *_: pytest.fail("it repaired"))
    return Enhancer(net, {REPAIR_GAIN: [WORTH - 0.01, WORTH - 0.01]})


def test_what_gained_too_little_in_training_is_left_out(enhancer, monkeypatch):
    assert enhancer.repairs == (True, True) and "flow_prev" in enhancer.reads
    rests = resting(stirred(), monkeypatch)
    assert rests.repairs == (False, False) and rests.reads == ("instance", "reference")
    assert Enhancer(stirred(), {REPAIR_GAIN: [0.0, WORTH]}).repairs == (False, True)
    assert Enhancer(stirred(), {REPAIR_GAIN: [0.0, 0.0]}, repair=True).repairs == (True, True)


@pytest.mark.parametrize("gains", [[WORTH, 0.0], [0.0, WORTH]])
def test_frames_without_and_with_photos_are_repaired_by_what_was_gained_on_such(gains):
    enhancer, rgb = Enhancer(stirred(), {REPAIR_GAIN: gains}), picture(64, 96)
    plain, _ = enhancer.step(frame(rgb))
    beside, _ = enhancer.step(frame(rgb, reference=rgb, trust=torch.ones(64, 96)))
    assert [not torch.equal(plain, rgb), not torch.equal(beside, rgb)] == [gain >= WORTH for gain in gains]


def test_a_shorter_history_is_of_the_last_frames():
    enhancer, memory = Enhancer(stirred(), history=1), None
    for i in range(2):
        _, memory = enhancer.step(picture(64, 96) + 0.01 * i, memory)
    past = memory.past

    def without(k):
        known = past.latents.clone()
        known[:, k] = 0
        return enhancer.step(picture(64, 96), replace(memory, past=replace(past, latents=known)))[0]

    shown, _ = enhancer.step(picture(64, 96), memory)
    assert torch.equal(without(1), shown) and not torch.equal(without(0), shown)


def test_without_repair_a_frame_of_which_nothing_is_told_comes_back_as_it_was(monkeypatch):
    rests, rgb = resting(stirred(), monkeypatch), picture(64, 96)
    better, memory = rests.step(rgb)
    again, memory = rests.step(better, memory)
    assert torch.equal(better, rgb) and torch.equal(again, rgb) and memory.past is None


def test_without_repair_nothing_but_told_objects_is_touched(monkeypatch):
    rests, rgb, instance = resting(stirred(), monkeypatch), picture(64, 96), torch.zeros(64, 96, dtype=torch.int32)
    better, memory = rests.step(frame(rgb, instance=instance))
    assert torch.equal(better, rgb) and memory.past is None
    instance[20:50, 30:60] = 1
    better, memory = rests.step(frame(rgb, instance=instance), memory)
    assert list(memory.objects) == [1] and torch.equal(better[:10], rgb[:10])
    _, after = rests.step(frame(rgb, instance=instance, need=torch.zeros(64, 96)), memory)
    assert list(after.objects) == [1]  # a frame that needed nothing forgets nothing


def striped(seed, h=64, w=96):
    """A picture with something to tell places by."""
    coarse = torch.rand(1, 3, 5, 7, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, (h, w), mode="bilinear")[0].permute(1, 2, 0).contiguous()


@pytest.mark.parametrize("flow", [None, torch.zeros(64, 96, 2)])
def test_a_cut_forgets_by_itself(enhancer, flow):
    _, memory = enhancer.step(frame(striped(1), flow_prev=flow))
    after, _ = enhancer.step(frame(striped(2), flow_prev=flow), memory)
    assert torch.allclose(after, enhancer.step(striped(2))[0], atol=2e-3)


def test_a_small_motion_is_no_cut(enhancer):
    _, memory = enhancer.step(striped(1))
    after, _ = enhancer.step(striped(1).roll(3, 1), memory)
    assert not torch.allclose(after, enhancer.step(striped(1).roll(3, 1))[0], atol=2e-3)


def test_what_photos_say_is_followed_as_far_as_it_is_trusted_where_there_is_need():
    rgb, reference = picture(64, 64), picture(64, 64, seed=1)
    trust, need = torch.zeros(64, 64), torch.ones(64, 64)
    trust[:, 16:], need[:32] = 0.5, 0
    plain = Enhancer(Net(SMALL))
    better, _ = plain.step(frame(rgb, reference=reference, trust=trust))
    assert torch.equal(better[:, :16], rgb[:, :16]) and torch.allclose(better[:, 16:], (rgb + reference)[:, 16:] / 2, atol=1e-6)
    part, _ = plain.step(frame(rgb, reference=reference, trust=trust, need=need))
    assert torch.equal(part[:32], rgb[:32]) and torch.equal(part[32:], better[32:])
    with pytest.raises(ValueError, match="trust"):
        plain.step(frame(rgb, reference=reference, trust=trust[:5]))


def told(seed, hue=(1.0, 1.0, 1.0), shift=0):
    """A smooth street with an object in other colours, told as 1, `shift` pixels to the right."""
    coarse = torch.rand(1, 3, 6, 9, generator=torch.Generator().manual_seed(seed))
    street = torch.nn.functional.interpolate(coarse, (96, 160), mode="bicubic", align_corners=False)[0].permute(1, 2, 0).clamp(0, 1)
    street = street.roll(shift, 1)
    instance = torch.zeros(96, 160, dtype=torch.int32)
    instance[30:70, 60 + shift : 110 + shift] = 1
    rgb = torch.where(instance[..., None] == 1, (street * torch.tensor(hue)).clamp(0, 1), street)
    return frame(rgb, instance=instance)


def test_an_object_keeps_its_colours_where_there_is_no_need():
    wrong, need = told(1, (0.5, 1.4, 0.5)), torch.zeros(96, 160)
    need[:, :96] = 1
    better, _ = Enhancer.load().step(replace(wrong, need=need))
    assert torch.equal(better[:, 96:], wrong.rgb[:, 96:]) and not torch.equal(better[30:70, 60:96], wrong.rgb[30:70, 60:96])


def test_after_a_cut_objects_begin_anew():
    """The shipped weights: an object told 12 times in wrong colours, then one of the same id elsewhere."""
    shipped, memory = Enhancer.load(), None
    for _ in range(12):
        better, memory = shipped.step(told(1, (0.5, 1.4, 0.5)), memory)
    assert memory.objects[1].count == 12
    after, memory = shipped.step(told(2), memory)
    alone, fresh = shipped.step(told(2))
    assert torch.equal(after, alone) and memory.objects[1].count == fresh.objects[1].count == 1


def test_what_moves_on_is_no_cut():
    shipped, memory = Enhancer.load(), None
    for i in range(4):
        _, memory = shipped.step(told(1, shift=2 * i), memory)
    assert memory.objects[1].count == 4
