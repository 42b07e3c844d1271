"""Laws that hold for every kind of splat file."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from randomized import gaussians

from scenes import Gaussians, load, load_dropping, save
from scenes.convert import convert, fidelity
from scenes.formats import COMPRESSED_PLY, FORMATS, PLY, SOG, SPLAT, SPZ, USD, found, named

SUFFIXES = [suffix for form in FORMATS for suffix in form.suffixes if suffix != ".usd"]
# at most, after a round trip of `splats`: metres, degrees, part of the scale, of opacity, of a coefficient
BOUNDS = {
    ".ply": (0, 0, 0, 0, 0),
    ".compressed.ply": (0.06, 0.2, 0.012, 0.0021, 0.016),  # a 2046th of a chunk's range; 10 bits a term; harmonics of 1/32
    ".usdc": (0, 1e-4, 2e-7, 1e-6, 0),
    ".usda": (0, 1e-4, 2e-7, 1e-6, 0),
    ".glb": (0, 1e-4, 2e-7, 1e-6, 0),
    ".spz": (3e-4, 0.3, 0.032, 0.0021, 0.25),  # steps of 2^-12 m, 1/16, 1/16 of a coefficient, turned beyond degree 1: of several
    ".splat": (0, 1.1, 2e-7, 0.0021, 0.0071),  # a byte a term, 1/510 of a colour
    ".sog": (0.005, 1.1, 0.08, 0.0021, 0.02),  # 16 bits of a logarithm; a byte a term; 256 scales and coefficients
}


def splats(count=600, coefficients=4, seed=0) -> Gaussians:
    """Splats that every format can hold: 50 m about, scales of 0.1 mm to 100 m, coefficients and colours within 1."""
    g = gaussians(count, coefficients, seed)
    return replace(g, means=g.means.clamp(-50, 50), log_scales=g.log_scales.clamp(-9, 4.6), sh=g.sh.clamp(-2.9, 2.9) / 2.9)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_a_round_trip_stays_within_the_steps_of_the_format(tmp_path, suffix, coefficients):
    before = splats(600, coefficients)
    told = convert(before, tmp_path / f"a{suffix}")
    off = told.position, told.rotation, told.scale, told.opacity, told.sh
    assert all(o <= most for o, most in zip(off, BOUNDS[suffix], strict=True)), off
    assert told.splats == 600 and told.bytes == (tmp_path / f"a{suffix}").stat().st_size
    after = load(tmp_path / f"a{suffix}")
    assert after.sh.shape[1] == (1 if suffix == ".splat" else coefficients)
    assert told.lost_degree == (before.sh_degree if suffix == ".splat" and coefficients > 1 else None)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_writing_what_was_read_changes_nothing_more(tmp_path, suffix):
    convert(splats(), tmp_path / f"a{suffix}")
    told = convert(load(tmp_path / f"a{suffix}"), tmp_path / f"b{suffix}")
    # terms of a quaternion that were rounded to bytes are rounded again, once they have length one
    assert (told.position, told.opacity) == (0, 0) and told.scale < 2e-7 and told.sh < 1e-6
    assert told.rotation < (1.1 if suffix in (".splat", ".sog") else 0.2 if suffix in (".spz", ".compressed.ply") else 1e-4)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_splats_beyond_what_a_float_holds_are_written_without_a_word_of_numpys(tmp_path, suffix):
    g = splats(20)
    g.log_scales[3], g.log_scales[4], g.sh[5], g.logit_opacities[6], g.quats[7] = 1e5, -1e5, 1e30, 1e30, 1e-40
    convert(g, tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("count", [0, 1, 256, 257])
def test_any_number_of_splats_survives(tmp_path, suffix, count):
    if suffix == ".glb" and not count:
        with pytest.raises(ValueError, match="at least one splat"):
            save(splats(0), tmp_path / "a.glb")
        assert not list(tmp_path.iterdir())
        return
    save(splats(count), tmp_path / f"a{suffix}")
    assert len(load(tmp_path / f"a{suffix}")) == count


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_opacities_at_both_ends_stay_there(tmp_path, suffix):
    g = replace(splats(3), logit_opacities=torch.tensor([-40.0, 0.0, 40.0]))
    save(g, tmp_path / f"a{suffix}")
    form = named(tmp_path / f"a{suffix}")
    first, last = (int((form.arranged(g).logit_opacities == v).nonzero()) for v in (-40, 40))
    logits = load(tmp_path / f"a{suffix}").logit_opacities
    assert -41 < logits[first] < -14 and 14 < logits[last] < 41


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_quaternions_of_any_length_are_the_rotations_that_they_are(tmp_path, suffix):
    g = splats(3)
    g.quats[:] = torch.tensor([[1e-42, 0, 0, -1e-42], [3e30, 1e30, 0, 0], [0.0, -0.5, 0.5, 0.0]])
    assert convert(g, tmp_path / f"a{suffix}").rotation <= BOUNDS[suffix][1]


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s not in (".usda", ".splat")])
def test_a_truncated_file_is_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save(splats(300), path)
    whole = path.read_bytes()
    for cut in [0, 1, 7, 20, *range(30, len(whole), len(whole) // 23), len(whole) - 1]:
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match="a\\."):
            load(path)


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".glb", ".splat"])
def test_values_that_are_not_finite_are_named_and_dropped_when_asked(tmp_path, suffix):
    """Of the other formats none can hold one: their bytes are all numbers."""
    g, path = splats(600), tmp_path / f"a{suffix}"
    g.means[5, 1] = float("nan")
    with pytest.raises(ValueError, match="splat 5 has nan in means"):
        save(g, path)
    assert not list(tmp_path.iterdir())
    form = replace(named(path), ordered=False)
    form.save(path, g)
    with pytest.raises(ValueError, match=r"a\..*splat \d+ has nan in means"):
        load(path)
    kept, dropped = load_dropping(path)
    assert dropped == (256 if suffix == ".compressed.ply" else 1) and len(kept) == 600 - dropped  # a chunk shares its range
    kept.validate()


def test_a_failed_write_leaves_what_was_there(tmp_path):
    g = splats(3)
    save(g, tmp_path / "a.spz")
    before = (tmp_path / "a.spz").read_bytes()
    with pytest.raises(ValueError, match="1e\\+09 m from the origin; SPZ holds"):
        save(replace(g, means=g.means + 1e9), tmp_path / "a.spz", overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.spz"] and (tmp_path / "a.spz").read_bytes() == before


def test_the_name_says_what_to_write_and_the_header_what_is_read(tmp_path):
    assert [named(Path(n)) for n in ("a.ply", "a.compressed.ply", "B.SPZ", "a.splat", "a.usda")] == [PLY, COMPRESSED_PLY, SPZ, SPLAT, USD]
    assert named(Path("a.obj")) is None and found(tmp_path / "missing.ply") is None
    save(splats(), tmp_path / "a.compressed.ply")
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.compressed.ply").read_bytes())
    assert found(tmp_path / "b.ply") is COMPRESSED_PLY and len(load(tmp_path / "b.ply")) == 600
    save(splats(4), tmp_path / "b.ply", overwrite=True)
    assert found(tmp_path / "b.ply") is PLY
    (tmp_path / "meta.json").write_text("{}")
    assert found(tmp_path) is SOG and found(tmp_path / "meta.json") is SOG
    with pytest.raises(ValueError, match=r'suffix ".obj"; splats can be written as .ply, .compressed.ply'):
        save(splats(), tmp_path / "a.obj")


def test_neighbours_follow_each_other_in_formats_of_chunks():
    g = splats(4000)
    for form in (COMPRESSED_PLY, SOG):
        steps = [(h.means[1:] - h.means[:-1]).norm(dim=1).mean() for h in (g, form.arranged(g))]
        assert steps[1] < 0.3 * steps[0]
        assert torch.equal(form.arranged(form.arranged(g)).means, form.arranged(g).means)


def test_fidelity_is_what_was_done_to_the_splats():
    g = splats(50, 9)
    half = torch.tensor(0.01)  # a turn of 0.02 rad about the splat's own x
    w, x, y, z = g.quats.unbind(1)
    c, s = half.cos(), half.sin()
    changed = replace(
        g,
        means=g.means + torch.tensor([0.3, 0.0, 0.4]),
        quats=-2 * torch.stack([w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s], 1),
        log_scales=g.log_scales + 0.1,
        sh=g.sh[:, :4] + 0.25,
    )
    told = fidelity(g, changed, 5000)
    assert told.position == pytest.approx(0.5, rel=1e-5) and told.rotation == pytest.approx(0.02 * 57.29578, rel=1e-4)
    assert told.scale == pytest.approx(1.1051709 - 1, rel=1e-5) and told.sh == pytest.approx(0.25, rel=1e-5) and told.opacity == 0
    assert told.lost_degree == 2 and "100.0 bytes each" in str(told) and "degree 2 are left out" in str(told)
    assert "off by at most nothing" in str(fidelity(g, g, 1))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_splats_that_do_not_lie_row_by_row_in_memory_are_written_alike(tmp_path, suffix):
    before = splats(20)
    save(before, tmp_path / f"a{suffix}")
    save(before.map(lambda t: t.mT.contiguous().mT if t.ndim == 2 else t), tmp_path / f"b{suffix}")
    assert torch.equal(load(tmp_path / f"a{suffix}").means, load(tmp_path / f"b{suffix}").means)
