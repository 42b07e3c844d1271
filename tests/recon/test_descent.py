import math

import torch
from randomized import gaussians

from recon.fit.densify import LARGEST, LONGEST, THINNEST, Growth
from recon.fit.descent import COLOURS, Descent, rates_at
from recon.fit.model import Splats

RATES = {"means": 1e-3, "quats": 2e-3, "log_scales": 1e-4, "logits": 4e-2, "colours": 5e-3, "harmonics": 5e-4}
FADE = 0.003


def splats(count=40):
    made = Splats.of([gaussians(count).with_sh_count(4)], [torch.full((count,), 2.0)])
    made.fields["log_scales"] = torch.full((count, 3), -4.0)
    return made


def follow(descent, all_splats, which, gradients, now):
    rates = rates_at(now, RATES, FADE)
    descent.catch_up(all_splats, which, 4, rates)
    shown = all_splats.select(which, 4)
    for name, g in gradients.items():
        shown.fields[name].grad = g
    growth = Growth.none(len(all_splats))
    descent.follow(all_splats, which, shown, rates, growth)
    return growth


def some_gradients(all_splats, generator, count=None):
    return {k: torch.randn(count or len(v), *v.shape[1:], generator=generator) for k, v in all_splats.fields.items()}


def test_splats_seen_now_and_then_move_as_torchs_adam_moves_them():
    """Dense Adam takes a step for every picture. While coasting only its bias correction differs: by a hundredth after some dozen steps."""
    ours, generator = splats(), torch.Generator().manual_seed(0)
    theirs = {k: v.clone().requires_grad_() for k, v in ours.fields.items()}
    adams = {k: torch.optim.Adam([v], lr=RATES.get(k, RATES["harmonics"]), eps=1e-15) for k, v in theirs.items()}
    descent, everything = Descent.begin(ours), torch.arange(40)
    start, fades = {k: v.clone() for k, v in ours.fields.items()}, torch.zeros(40)
    for now in range(1, 121):
        which = everything if now < 50 else (torch.rand(40, generator=generator) < 0.3).nonzero()[:, 0]
        gradients = some_gradients(ours, generator, len(which))
        follow(descent, ours, which, gradients, now)
        fades[which] += FADE
        for k, g in gradients.items():
            theirs[k].grad = torch.zeros_like(theirs[k]).index_copy_(0, which, g)
            adams[k].step()
    descent.catch_up(ours, everything, 4, rates_at(121, RATES))
    for name, rate in (("means", 2 * RATES["means"]), ("quats", 2e-3), ("log_scales", 1e-4), ("logits", 4e-2), ("sh", 5e-4)):
        scale = 2.0 if name == "means" else 1.0  # reach
        moved, meant = ours.fields[name] - start[name], scale * (theirs[name].detach() - start[name])
        if name == "logits":
            moved = moved + fades
        if name == "sh":
            moved, meant = moved[:, 1:], meant[:, 1:]
        assert (moved - meant).abs().max() < 0.3 * rate and meant.abs().max() > 8 * rate, name


def test_splats_that_a_picture_does_not_show_stay_as_they_are():
    ours = splats()
    before, descent = {k: v.clone() for k, v in ours.fields.items()}, Descent.begin(ours)
    which = torch.tensor([3, 5, 30])
    gradients = some_gradients(ours, torch.Generator().manual_seed(1), 3)
    for g in gradients.values():
        g[1] = 0  # in the view, but hidden
    growth = follow(descent, ours, which, gradients, 1)
    moved = torch.zeros(40, dtype=torch.bool)
    moved[[3, 30]] = True
    for name, field in ours.fields.items():
        assert torch.equal((field != before[name]).reshape(40, -1).any(1), moved), name
    assert torch.equal(descent.last == 1, moved)
    assert torch.equal(growth.pulled == 1, moved)
    torch.testing.assert_close(growth.pull[which], 2 * gradients["means"].norm(dim=1))  # times reach


def test_scales_stay_within_what_cameras_can_tell():
    ours = splats()
    ours.fields["log_scales"][:] = torch.tensor([9.0, -1.0, -30.0])
    follow(Descent.begin(ours), ours, torch.arange(40), some_gradients(ours, torch.Generator().manual_seed(3)), 1)
    scales = ours.fields["log_scales"].exp()
    assert (scales.amax(1) <= 2 * LARGEST * 1.001).all() and (scales.amin(1) >= 2 * THINNEST * 0.999).all()
    assert (scales.amax(1) <= scales.median(1).values * LONGEST * 1.01).all() and math.isfinite(float(scales.sum()))


def test_it_is_known_whose_colours_were_pulled_at():
    """By what they were once, too, and when their momentum has been taken from them."""
    ours, everything = splats(), torch.arange(40)
    descent = Descent.begin(ours)
    gradients = some_gradients(ours, torch.Generator().manual_seed(2))
    gradients["sh"][:25] = 0
    follow(descent, ours, everything, gradients, 1)
    assert torch.equal(descent.coloured(), everything >= 25)
    before = ours.fields["sh"].clone()
    descent.still(everything >= 30, COLOURS)
    descent.catch_up(ours, everything, 4, rates_at(9, RATES, FADE))
    moved = (ours.fields["sh"] != before).any(2).any(1)
    assert torch.equal(descent.coloured(), everything >= 25) and torch.equal(moved, (everything >= 25) & (everything < 30))
