import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.hdr import load_hdr, save_hdr


def image(height, width, seed=0):
    """Light over ten orders of magnitude, with flat parts and black ones."""
    dice = torch.Generator().manual_seed(seed)
    out = torch.rand(height, width, 3, generator=dice) * 10 ** (10 * torch.rand(height, width, 1, generator=dice) - 5)
    out[: height // 2, : width // 2] = 0.25
    out[height // 2, width // 2] = 0
    return out


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (3, 8), (16, 33), (4, 300)])
def test_a_pixel_returns_within_a_256th_of_its_largest_channel(tmp_path, size):
    before = image(*size)
    save_hdr(tmp_path / "a.hdr", before)
    after = load_hdr(tmp_path / "a.hdr")
    assert ((after - before).abs() <= before.amax(-1, keepdim=True) / 256).all()
    save_hdr(tmp_path / "b.hdr", after)
    assert torch.equal(load_hdr(tmp_path / "b.hdr"), after)


def test_what_an_image_was_multiplied_by_is_taken_out(tmp_path):
    save_hdr(tmp_path / "a.hdr", torch.full((2, 3, 3), 0.5))
    data = (tmp_path / "a.hdr").read_bytes()
    (tmp_path / "a.hdr").write_bytes(data.replace(b"FORMAT", b"EXPOSURE=4\nEXPOSURE=0.5\nFORMAT", 1))
    assert (load_hdr(tmp_path / "a.hdr") == 0.25).all()


@settings(max_examples=40)
@given(st.lists(st.sampled_from([0.0, 0.5, 0.75, 1.0, 3.0]), min_size=8, max_size=700))
def test_runs_of_any_length_return(tmp_path_factory, row):
    path = tmp_path_factory.getbasetemp() / "runs.hdr"
    before = torch.tensor(row)[None, :, None].expand(2, -1, 3)
    save_hdr(path, before)
    assert torch.equal(load_hdr(path), before)


@pytest.mark.parametrize("value", [255.5, 255.999, 0.99999, 1e-38, 1.6e38])
def test_light_near_a_power_of_two_or_the_ends_of_the_range_returns(tmp_path, value):
    save_hdr(tmp_path / "a.hdr", torch.full((1, 1, 3), value))
    assert load_hdr(tmp_path / "a.hdr")[0, 0].tolist() == pytest.approx([value] * 3, rel=1 / 256)


def test_light_that_is_not_finite_or_too_bright_is_refused(tmp_path):
    for value in (float("nan"), float("inf"), 3.4e38):
        with pytest.raises(ValueError, match="cannot write"):
            save_hdr(tmp_path / "a.hdr", torch.full((2, 2, 3), value))
    assert not list(tmp_path.iterdir())


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "a.hdr"
    for width in (5, 40):
        save_hdr(path, image(6, width))
        whole = path.read_bytes()
        for cut in range(0, len(whole), 11):
            path.write_bytes(whole[:cut])
            with pytest.raises(ValueError, match="truncated|corrupt|not a Radiance"):
                load_hdr(path)


@pytest.mark.parametrize(
    "data, said",
    [
        (b"\x89PNG\r\n", "not a Radiance"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n0000", "32-bit_rle_xyze"),
        (b"#?RADIANCE\n\n+Y 1 +X 1\n0000", "size line"),
        (b"#?RADIANCE\n\n-Y 0 +X 1\n", "corrupt"),
        (b"#?RADIANCE\n\n-Y 99999999 +X 99999999\n0000", "truncated"),
        (b"#?RADIANCE\n\n-Y 1 +X 9\n\x02\x02\x00\x09\xff\x00" + bytes(40), "corrupt at row 0"),
    ],
)
def test_foreign_or_corrupt_images_are_refused(tmp_path, data, said):
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(ValueError, match=said):
        load_hdr(tmp_path / "a.hdr")


def test_published_skies_open(shared):
    for path in sorted((shared / "envmaps").glob("*.hdr")):
        sky = load_hdr(path)
        assert sky.shape == (512, 1024, 3) and torch.isfinite(sky).all()
        assert sky[:256].mean() > sky[256:].mean()  # the sky is brighter than the ground
