"""What a seam tells of an object's colours, without anything learnt about streets."""

import pytest
import torch

from enhance.correcting.objects import COEFFICIENTS, Objects, changed
from enhance.correcting.outlines import Outline, Outlines, boxes, reaching_over
from enhance.correcting.seam import Fit, effects, fitted, usual_changes
from enhance.pairs.isp import Isp, alter

NOTHING = torch.zeros(COEFFICIENTS)
BROAD = 0.5 * torch.eye(COEFFICIENTS)
ISP = Isp(exposure=-0.6, red=0.2, blue=-0.2, saturation=0.7)


def surface(seed=0, grain=0.01, h=240, w=360, wide=8):
    """A picture of stripes of many colours that go on from side to side, but for a little grain."""
    drawn = torch.Generator().manual_seed(seed)
    stripes = (0.15 + 0.7 * torch.rand(3, h // wide, 1, generator=drawn)).repeat_interleave(wide, 1)
    return (stripes + grain * torch.randn(3, h, w, generator=drawn)).clamp(0.02, 0.98)


def region(h=240, w=360):
    ids = torch.zeros(h, w, dtype=torch.int32)
    ids[60:180, 90:270] = 1
    return ids


def seam(rgb, ids, guess=NOTHING, usual=BROAD, over=0):
    """The fit along the edge of a mask, or along that of one some pixels larger."""
    box = boxes(ids)[1]
    for _ in range(over):
        ids = reaching_over(ids)
    (fit,) = fitted(rgb, Outlines([Outline.of(ids, 1, box)]), guess[None], usual)
    return fit


def found(rgb, ids, guess=NOTHING, usual=BROAD):
    fit = seam(rgb, ids, guess, usual)
    return fit.coefficients, fit.ends


def left(rgb, right, ids, coefficients):
    """Root of the mean squared error in the object with a change and without, in levels."""
    mask, box = ids == 1, boxes(ids)[1]
    height = box.placed(*mask.nonzero().unbind(1))[:, 0]
    given, wanted = rgb[:, mask].T, right[:, mask].T
    better = given + changed(given[None], height[None], coefficients[None])[0]
    return [255 * float((x - wanted).square().mean().sqrt()) for x in (better, given)]


def test_colours_that_jump_at_the_seam_of_one_surface_are_put_right():
    right, ids = surface(), region()
    rgb = alter(right, (ids == 1).float()[None], ISP)
    after, before = left(rgb, right, ids, found(rgb, ids)[0])
    assert after < before / 2.5 and before > 20


def test_a_wrong_guess_is_undone_and_one_without_usual_changes_kept():
    right, ids, guess = surface(1), region(), torch.linspace(-0.1, 0.1, COEFFICIENTS)
    after, guessed = (left(right, right, ids, k)[0] for k in (found(right, ids, guess)[0], guess))
    assert after < guessed / 3
    assert torch.equal(found(right, ids, guess, torch.zeros(COEFFICIENTS, COEFFICIENTS))[0], guess)


def test_what_is_right_stays_nearly_so_and_its_surface_does_not_end():
    right, ids = surface(2), region()
    coefficients, ends = found(right, ids)
    assert left(right, right, ids, coefficients)[0] < 2 and ends == 0


def test_an_object_of_other_colours_ends_at_its_seam():
    ids, patches = region(), torch.rand(3, 12, 18, generator=torch.Generator().manual_seed(4))
    rgb = torch.where(ids == 1, patches.repeat_interleave(20, 1).repeat_interleave(20, 2), surface(3, wide=40))
    assert found(rgb, ids)[1] == 1


def test_what_ends_at_the_mask_s_edge_is_put_right_by_the_seam_there():
    """A mask a pixel larger has some of what is right on its side, along slanting edges above all."""
    right = surface(5, wide=16)
    y, x = torch.meshgrid(torch.arange(240) - 120, torch.arange(360) - 180, indexing="ij")
    ids = (abs(x) + 1.5 * abs(y) < 130).int()
    rgb = alter(right, (ids == 1).float()[None], ISP)
    edge, beyond = seam(rgb, ids), seam(rgb, ids, over=1)
    coefficients, ends = edge.with_beyond(beyond)
    assert left(rgb, right, ids, coefficients)[0] < 0.8 * left(rgb, right, ids, beyond.coefficients)[0]
    assert edge.undoes == 1 and ends == 0


def test_what_no_change_undoes_is_taken_for_the_smaller_one():
    assert seam(surface(2), region()).undoes == 0
    small, large = Fit(NOTHING, 0.1, 0, 1), Fit(NOTHING + 1, 0.2, 0, 0)
    for one, other in ((small, large), (large, small)):
        coefficients, ends = one.with_beyond(other)
        assert torch.equal(coefficients, NOTHING) and ends == 1


def test_what_shows_little_of_its_seam_is_not_said_to_end_there():
    patches = torch.rand(3, 12, 18, generator=torch.Generator().manual_seed(4)).repeat_interleave(20, 1).repeat_interleave(20, 2)
    for side, ends in ((12, 0), (40, 1)):
        ids = torch.zeros(240, 360, dtype=torch.int32)
        ids[100 : 100 + side, 150 : 150 + side] = 1
        flat = torch.full_like(patches, 0.5)
        assert seam(torch.where(ids == 1, patches.roll(7, 1).roll(5, 2), flat), ids).ends == ends


@pytest.mark.parametrize("grain", [0.02, 0.04, 0.08, 0.16])
def test_a_surface_goes_on_however_rough_it_is(grain):
    """Of flecks three pixels wide: across the seam colours differ as they do beside it."""
    drawn = torch.Generator().manual_seed(6)
    rough = (0.5 + grain * torch.randn(3, 80, 120, generator=drawn)).clamp(0.02, 0.98)
    assert found(rough.repeat_interleave(3, 1).repeat_interleave(3, 2), region())[1] < 0.2


def test_neighbouring_objects_and_the_picture_s_end_are_no_surroundings():
    rgb, ids = surface(), torch.full((240, 360), 2, dtype=torch.int32)
    ids[:, 90:270] = 1  # from the top of the picture to its end, between two other objects
    guess = torch.ones(COEFFICIENTS)
    coefficients, ends = found(rgb, ids, guess)
    assert torch.equal(coefficients, guess) and ends == 0


def test_effects_are_those_of_the_change():
    rgb, height, k = torch.rand(7, 3), torch.rand(7) * 2 - 1, torch.randn(COEFFICIENTS)
    torch.testing.assert_close(effects(rgb, height) @ k, changed(rgb[None], height[None], k[None])[0])


def test_usual_changes_are_those_of_the_objects():
    drawn = torch.Generator().manual_seed(0)
    given, height = torch.rand(400, 200, 3, generator=drawn), torch.rand(400, 200, generator=drawn) * 2 - 1
    by = 0.1 * torch.randn(400, 1, 1, generator=drawn)
    root = usual_changes(Objects(None, given, given + by, height))
    covariance = root @ root.T
    assert covariance[0, 0].sqrt() == pytest.approx(0.1, rel=0.15) and covariance[0, 1] == pytest.approx(float(covariance[0, 0]), rel=0.05)
    assert covariance.diagonal()[3:].max() < 1e-3


def test_seams_read_together_say_what_each_says_alone():
    rgb = surface(7)
    ids = torch.zeros(240, 360, dtype=torch.int32)
    ids[20:80, 30:100], ids[100:220, 120:300], ids[232:, :8] = 1, 2, 3  # the last, in a corner, has too few profiles
    found = boxes(ids)
    rgb = alter(rgb, (ids == 2).float()[None], ISP)
    outlines = [Outline.of(each, i, found[i]) for each in (ids, reaching_over(ids)) for i in found]
    guesses = 0.1 * torch.randn(len(outlines), COEFFICIENTS, generator=torch.Generator().manual_seed(8))
    together = fitted(rgb, Outlines(outlines), guesses, BROAD)
    for outline, guess, fit in zip(outlines, guesses, together, strict=True):
        (alone,) = fitted(rgb, Outlines([outline]), guess[None], BROAD)
        torch.testing.assert_close(fit.coefficients, alone.coefficients, atol=1e-4, rtol=1e-3)
        assert (fit.by, fit.undoes, fit.ends) == pytest.approx((alone.by, alone.undoes, alone.ends), abs=1e-3)
    assert [fit.by == float("inf") for fit in together] == [False, False, True] * 2 and together[1].undoes == 1 > together[0].undoes
