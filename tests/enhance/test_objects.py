"""Colours of told objects: what is read of them, and what is done."""

import numpy as np
import torch

from enhance import Enhancer
from enhance.clip import telling
from enhance.correcting import corrections
from enhance.correcting.corrections import DEEP, SLIGHT, STEADY, Correction, correct
from enhance.correcting.objects import (
    COEFFICIENTS,
    PIXELS,
    REACH,
    SEAM,
    Evidence,
    ObjectNet,
    changed,
    evidence,
    spots,
    whole_of,
)
from enhance.correcting.outlines import FEWEST, Outline, Outlines, boxes, reaching_over
from enhance.correcting.shade import KNOTS, READ
from enhance.demo import CAMERA, DATA, MOVING, PARKED, SHIFT
from enhance.training.object_samples import ObjectSampler
from render import render_clip
from scenes import Databank, load
from scenes.insert import insert
from scenes.placement import parse_placement


def scene(top=10, left=20, height=16, width=24, seed=0):
    """A picture `[3, 64, 96]` and the ids of one object in it."""
    rgb = torch.rand(3, 64, 96, generator=torch.Generator().manual_seed(seed))
    instance = torch.zeros(64, 96, dtype=torch.int32)
    instance[top : top + height, left : left + width] = 5
    return rgb, instance


def read(rgb, instance):
    ((i, box),) = boxes(instance).items()
    at = spots(Outlines([Outline.of(instance, i, box)]), instance.numel())
    return evidence(rgb[:, at.yx[..., 0], at.yx[..., 1]].movedim(0, -1), at, whole_of(rgb)), at


def stirred():
    torch.manual_seed(0)
    net = ObjectNet(width=16, heads=2, questions=2, rounds=1).eval()
    torch.nn.init.normal_(net.last.weight, std=0.05)
    return net


def test_a_new_network_changes_nothing():
    rgb, instance = scene()
    assert torch.equal(correct(ObjectNet(), rgb, instance, {})[0], rgb)


def test_profiles_lead_out_of_the_object():
    e, at = read(*scene())
    assert int(at.known.sum()) == 2 * (16 + 24)
    seen = e.seam[at.known]
    assert (seen[:, :REACH, 3] == 1).all() and (seen[:, REACH:, 3] == 0).all()


def test_a_profile_shows_the_pixels_on_its_way():
    rgb, instance = scene()
    rgb[:, :, 43], rgb[:, :, 44] = 0.25, 0.75  # the object's last column, and the next
    e, at = read(rgb, instance)
    rightwards = e.seam[at.known & (at.along[..., 1] == 1)]
    assert (rightwards[:, REACH - 1, :3] == -0.5).all() and (rightwards[:, REACH, :3] == 0.5).all()


def test_where_the_picture_ends_is_no_seam():
    _, at = read(*scene(top=0, left=0, height=64, width=96))
    assert not at.known.any()
    _, at = read(*scene(top=0, left=0, height=64, width=48))
    assert int(at.known.sum()) == 64 and (at.along[at.known] == torch.tensor([0.0, 1.0])).all()


def test_what_is_no_seam_has_no_influence():
    net, (e, _) = stirred(), read(*scene(top=0, left=0, height=64, width=96))
    other = Evidence(e.seam + 1, e.place - 1, e.known, e.inside, e.around, e.whole)
    assert torch.allclose(net(e), net(other), atol=1e-6)


def test_only_told_objects_change_and_small_ones_do_not():
    rgb, instance = scene()
    instance[50:54, 50:60] = 7
    assert FEWEST > 4 * 10
    better, found = correct(stirred(), rgb, instance, {})
    assert set(found) == {5}
    differs = (better != rgb).any(0)
    assert differs[instance == 5].float().mean() > 0.9 and not differs[instance != 5].any()


def test_ids_may_be_as_high_as_they_come():
    """As of masks whose colours stand for objects: a list of all ids up to the highest would take the memory."""
    _, instance = scene()
    instance[40:60, 40:60] = 7
    low, high = boxes(instance), boxes(torch.where(instance > 0, instance + (2**31 - 8), instance))
    assert list(low) == [5, 7] and list(high) == [2**31 - 3, 2**31 - 1] and list(low.values()) == list(high.values())


def test_where_no_mask_is_told_nothing_changes():
    rgb, _ = scene()
    assert torch.equal(correct(stirred(), rgb, torch.zeros(64, 96), {})[0], rgb)


def test_an_object_s_corrections_are_averaged_over_frames():
    net, (first, instance), (second, _) = stirred(), scene(seed=1), scene(seed=2)
    _, once = correct(net, first, instance, {})
    _, alone = correct(net, second, instance, {})
    _, both = correct(net, second, instance, once)
    for found in ("colours", "depths"):
        mean = (getattr(once[5], found) + getattr(alone[5], found)) / 2
        assert torch.allclose(getattr(both[5], found), mean, atol=1e-6) and both[5].count == 2
    _, gone = correct(net, second, torch.zeros_like(instance), both)
    assert gone == {}


def test_an_object_long_known_is_looked_at_rarely():
    net, (rgb, instance) = stirred(), scene()
    known = {5: Correction(torch.zeros(COEFFICIENTS), torch.zeros(KNOTS), None, None, STEADY)}
    looks = []
    for _ in range(2 * STEADY):
        _, after = correct(net, rgb, instance, known)
        looks.append(not torch.equal(after[5].colours, known[5].colours))
        known = after
    assert sum(looks) == 2


def test_coefficients_offset_scale_and_grey():
    rgb, height = torch.rand(1, 50, 3), torch.linspace(-1, 1, 50)[None]
    c = torch.zeros(1, COEFFICIENTS)
    c[:, 0], c[:, 4] = 0.1, -0.5
    assert torch.allclose(changed(rgb, height, c), torch.stack([torch.full((1, 50), 0.1), -0.5 * rgb[..., 1], 0 * rgb[..., 2]], -1))
    c = torch.zeros(1, COEFFICIENTS)
    c[:, 9:12] = 1
    grey = rgb + changed(rgb, height, c)
    assert torch.allclose(grey, grey[..., :1].expand_as(grey), atol=1e-6)
    c = torch.zeros(1, COEFFICIENTS)
    c[:, 12:] = 0.5
    assert torch.allclose(changed(rgb, height, c), 0.5 * height[..., None] * rgb)


def test_a_missing_shadow_darkens_the_ground_by_the_object_and_nothing_else():
    rgb, instance = scene()
    rgb = torch.where(instance == 5, 0.6, 0.0) + 0.4 * rgb
    instance[20:60, 50:70] = 7
    net = ObjectNet(width=16, heads=2, questions=2, rounds=1).eval()
    with torch.no_grad():
        net.shade.layers[-1].bias[:] = 0.5
    better, _ = correct(net, rgb, torch.where(instance == 7, -1, instance), {})
    darker = (better < rgb).all(0)
    assert darker[26, 20:44].all() and not darker[instance == 5].any() and torch.equal(better[:, :, 75:], rgb[:, :, 75:])
    assert (better <= rgb + 1e-6).all()
    assert not (correct(net, rgb, instance, {})[0] != rgb).any(0)[instance > 0].any()


def test_the_ground_is_read_up_to_the_mask_s_edge(monkeypatch):
    """As it was learnt: where an object touches its ground it is darkest, and without that it seems to lack a shadow."""
    rgb, instance = scene()
    seen = []
    monkeypatch.setattr(corrections, "read_ground", lambda rgb, places, known: seen.append(places[known]) or torch.zeros(1, READ))
    correct(stirred(), rgb, instance, {})
    (box,) = boxes(instance).values()
    below = box.placed(torch.tensor([box.rows.stop]), torch.tensor([30]))
    assert (seen[0] == below).all(1).any()


def added(colours=0.0, depth=0.0):
    """What is added to a grey object and its ground that are told to be off by so much: largest changes of the one and the other."""
    _, instance = scene()
    rgb, coefficients = torch.full((3, 64, 96), 0.5), torch.zeros(COEFFICIENTS)
    coefficients[:3] = colours
    known = {5: Correction(coefficients, torch.full((KNOTS,), depth), None, None, STEADY + 1)}  # of which none is due in this frame
    difference = (correct(ObjectNet(), rgb, instance, known)[0] - rgb).abs()
    return float(difference[:, instance == 5].max()), float(difference[:, instance != 5].max())


def test_corrections_fade_in_beyond_what_is_slight():
    """Averages over a clip that wander about a threshold must not make colours or a shadow come and go."""
    steps = torch.linspace(0, 3, 61).tolist()
    colours = torch.tensor([added(colours=SLIGHT * k)[0] for k in steps])
    shadow = torch.tensor([added(depth=DEEP * k)[1] for k in steps])
    for made in (colours, shadow):
        assert (made[:21] == 0).all() and made[30] > 0 and (made.diff() >= 0).all() and made.diff().max() < 0.1 * made[-1]
    assert 2.5 * SLIGHT < colours[-1] < 3 * SLIGHT


def test_draws_repeat_and_are_right_or_wrong():
    photos = [np.random.default_rng(i).integers(0, 255, (120, 160, 3), dtype=np.uint8) for i in range(2)]
    sampler = ObjectSampler({}, photos)
    drawn, again = (sampler.draw(np.random.default_rng(3), 24) for _ in range(2))
    assert torch.equal(drawn.given, again.given) and torch.equal(drawn.evidence.seam, again.evidence.seam)
    assert drawn.given.shape == (24, PIXELS, 3) and drawn.evidence.seam.shape == (24, SEAM, 2 * REACH, 4)
    apart = (drawn.given - drawn.target).abs().amax((1, 2))
    assert 0 < (apart < 2 / 255).float().mean() < 1


def test_it_learns_an_exposure_from_the_seam():
    """Flat pictures in which the object is darker by half or not: the profiles tell."""
    torch.manual_seed(0)
    net = ObjectNet(width=16, heads=2, questions=2, rounds=1)
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    drawn = [(k, 0.3 + 0.6 * i / 15) for i in range(16) for k in (0.5, 1.0)]
    read_of = []
    for k, level in drawn:
        _, instance = scene()
        read_of.append(read(torch.where(instance == 5, k * level, level).expand(3, -1, -1), instance)[0])
    e = Evidence.stacked(read_of)
    given, target = (torch.tensor(v)[:, None, None].expand(-1, 8, 3) for v in ([k * v for k, v in drawn], [v for _, v in drawn]))
    for _ in range(80):
        loss = (given + changed(given, torch.zeros(32, 8), net(e)) - target).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.3 * (given - target).abs().mean()


def test_an_object_that_fills_the_frame_keeps_its_colours():
    rgb, instance = torch.rand(3, 64, 96), torch.ones(64, 96, dtype=torch.int32)
    assert torch.equal(correct(stirred(), rgb, instance, {})[0], rgb)
    instance[:, 60:] = 0
    assert not torch.equal(correct(stirred(), rgb, instance, {})[0], rgb)


def test_objects_are_looked_at_a_pixel_over_their_edge():
    ids = torch.tensor([[-1, -1, 0, 0, 0], [-1, 2**31 - 8, 0, 0, 7], [0, 0, 0, 0, 7], [0, 0, 0, 0, 3]], dtype=torch.int32)
    far = 2**31 - 8
    assert reaching_over(ids).tolist() == [[far, far, far, 7, 7], [far, far, far, 7, 7], [far, far, far, 7, 7], [0, 0, 0, 7, 3]]
    assert ids[0, 0] == -1
    all_of_it = torch.full((4, 5), 2)
    assert torch.equal(reaching_over(all_of_it), all_of_it)


def test_cars_of_the_street_that_are_put_into_it_keep_their_colours_in_a_clip():
    """At their edges, where pixels are a mixture of them and the street, they differ from what is around; that is no wrong light. (Of
    single frames one in six is taken to be a few levels off: what is done is the mean over a clip's, and of what is hardly more than
    slight, little.)"""
    street, net = load(DATA / "drive002"), Enhancer.load("builtin").net.objects
    start = int(street.frame_times(CAMERA)[0])
    for text in (PARKED, MOVING):
        placement = parse_placement(text)
        street = insert(street, Databank(DATA / "databank").load(placement.asset), placement, start).scene
    before, times = {}, [start + 400_000 + 100_000 * k for k in range(10)]
    for frame in render_clip(street, CAMERA, SHIFT, times, 640, 360, outputs=("rgb", "instance")):
        told = telling(frame, street.anew())
        rgb = told.rgb.permute(2, 0, 1).clamp(0, 1)
        better, before = correct(net, rgb, told.instance, before)
        assert (told.instance > 0).sum() > 5000
        for i in before:
            made = (better - rgb)[:, told.instance == i]
            assert made.square().mean().sqrt() < SLIGHT
