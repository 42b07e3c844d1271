"""Packed formats against their texts, decoded here splat by splat, and against files that their authors' tools wrote."""

import gzip
import json
import math
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from randomized import gaussians

from scenes import load, save
from scenes.formats.codebook import codebook, nearest, palette
from scenes.formats.spz import load_spz, save_spz
from scenes.formats.transform import Z_FROM_Y_UP
from scenes.poses import matrix_from_quat

C0 = 0.28209479177387814


def alike(g, i, means, quats, log_scales, opacity, dc):
    """Splat `i` is what plain arithmetic says, rotations up to sign."""
    got = g.means[i], g.log_scales[i], g.logit_opacities[i].sigmoid(), g.sh[i, 0]
    for value, wanted in zip(got, (means, log_scales, opacity, dc), strict=True):
        assert value.tolist() == pytest.approx(wanted, rel=1e-5, abs=1e-5)
    assert abs(float(g.quats[i].double() @ torch.tensor(quats, dtype=torch.float64))) == pytest.approx(1, abs=1e-5)


def largest_restored(which, three):
    quats = [*three[:which], math.sqrt(max(0, 1 - sum(v * v for v in three))), *three[which:]]
    return [q / math.hypot(*quats) for q in quats]


def test_superspsplats_biker_is_read_as_its_format_says(shared):
    path = shared / "splats" / "biker.compressed.ply"
    g, data = load(path), path.read_bytes()
    assert len(g) == 152746 and g.sh_degree == 0
    assert float(g.means[:, 1].max() - g.means[:, 1].min()) == pytest.approx(3.18, abs=0.01)
    start = data.index(b"end_header\n") + 11
    for i in (0, 1, 255, 256, 77777, 152745):
        ranges = struct.unpack_from("<18f", data, start + i // 256 * 72)
        position, rotation, scale, colour = struct.unpack_from("<4I", data, start + 597 * 72 + 16 * i)

        def between(word, at, ranges=ranges):
            shares = (word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047
            return [ranges[at + j] * (1 - s) + ranges[at + 3 + j] * s for j, s in enumerate(shares)]

        three = [((rotation >> shift & 1023) / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)]
        rgb = [ranges[12 + j] + (ranges[15 + j] - ranges[12 + j]) * (colour >> 24 - 8 * j & 255) / 255 for j in range(3)]
        dc = [(c - 0.5) / C0 for c in rgb]
        alike(g, i, between(position, 0), largest_restored(rotation >> 30, three), between(scale, 6), (colour & 255) / 255, dc)


@pytest.mark.parametrize("level", ["2_0", "6_0"])
def test_splat_transforms_playbot_is_read_as_its_format_says(shared, level):
    from PIL import Image

    folder = shared / "splats" / "playbot_sog" / level
    g, meta = load(folder), json.loads((folder / "meta.json").read_text())
    assert len(g) == meta["count"] and g.sh_degree == meta["shN"]["bands"]
    pictures = {p.stem: np.array(Image.open(p).convert("RGBA")) for p in folder.glob("*.webp")}
    flat = {name: picture.reshape(-1, 4).astype(int) for name, picture in pictures.items() if name != "shN_centroids"}
    for i in (0, 1, len(g) // 2, len(g) - 1):
        means = []
        for j in range(3):
            low, high = meta["means"]["mins"][j], meta["means"]["maxs"][j]
            v = low + (high - low) * (flat["means_l"][i, j] + 256 * flat["means_u"][i, j]) / 65535
            means.append(math.copysign(math.exp(abs(v)) - 1, v))
        *three, tag = flat["quats"][i]
        quats = largest_restored(tag - 252, [(v / 255 - 0.5) * math.sqrt(2) for v in three])
        scales = [meta["scales"]["codebook"][v] for v in flat["scales"][i, :3]]
        dc = [meta["sh0"]["codebook"][v] for v in flat["sh0"][i, :3]]
        alike(g, i, means, quats, scales, flat["sh0"][i, 3] / 255, dc)
        label, width = flat["shN_labels"][i, 0] + 256 * flat["shN_labels"][i, 1], g.sh.shape[1] - 1
        texels = pictures["shN_centroids"][label // 64, label % 64 * width : (label % 64 + 1) * width, :3]
        assert g.sh[i, 1:].tolist() == pytest.approx(np.array(meta["shN"]["codebook"])[texels], rel=1e-6)
    assert torch.equal(load(folder / "meta.json").means, g.means)


def test_an_spz_file_is_what_niantics_page_says(tmp_path):
    """One splat of degree 1, written by hand from the page, in all versions."""
    blocks = {
        "position": b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1.5, -2.25, 0.0)),
        "alpha": bytes([51]),
        "colour": bytes([255, 0, 51]),
        "scale": bytes([160, 0, 255]),
        "sh": bytes([128, 0, 255, 64, 192, 128, 128, 128, 128]),
    }
    xyzw = 0.1, -0.2, 0.3, math.sqrt(1 - 0.14)
    word = 3
    for v in xyzw[:3]:
        word = word << 10 | (v < 0) << 9 | round(511 * abs(v) * math.sqrt(2))
    for version in (2, 3, 4):
        rotation = bytes(round(v * 127.5 + 127.5) for v in xyzw[:3]) if version == 2 else word.to_bytes(4, "little")
        parts = [blocks["position"], blocks["alpha"], blocks["colour"], blocks["scale"], rotation, blocks["sh"]]
        if version < 4:
            data = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, 1, 1, 12, 1, 0) + b"".join(parts))
        else:
            import zstandard

            streams = [zstandard.compress(part) for part in parts]
            data = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 1, 12, 1, 6, 40) + b"\0" * 8  # 8 bytes of an extension
            data += b"".join(struct.pack("<QQ", len(s), len(p)) for s, p in zip(streams, parts, strict=True)) + b"".join(streams)
        (tmp_path / "a.spz").write_bytes(data)
        g = load(tmp_path / "a.spz")
        dc = [(v / 255 - 0.5) / 0.15 for v in blocks["colour"]]
        assert g.means[0].tolist() == [1.5, 0.0, -2.25] and g.log_scales[0].tolist() == [0.0, -10.0, 255 / 16 - 10]  # y up is z up here
        assert g.logit_opacities[0].sigmoid() == pytest.approx(0.2) and g.sh[0, 0].tolist() == pytest.approx(dc, rel=1e-6)
        # of degree 1 they are those of -y, z and -x: the file's (0, -1, 127 / 128), (-0.5, 0.5, 0), 0, where y is z and z is -y here
        assert g.sh[0, 1:].flatten().tolist() == pytest.approx([-0.5, 0.5, 0, 0, 1, -127 / 128, 0, 0, 0], abs=1e-6)
        wanted = Z_FROM_Y_UP[:3, :3].float() @ matrix_from_quat(torch.tensor([xyzw[3], *xyzw[:3]]))
        assert (matrix_from_quat(g.quats[0]) - wanted).abs().max() < (0.02 if version == 2 else 0.004)


def test_a_splat_file_is_what_its_authors_converter_writes(tmp_path):
    """One record by hand, as antimatter15's convert.py has it: position, scale, RGBA, and w, x, y, z about 128."""
    quat = 0.8, -0.2, 0.4, 0.4
    record = struct.pack("<6f8B", 1.5, -2.25, 0.5, 0.1, 2.0, 0.003, 255, 0, 51, 102, *(round(128 + 128 * q) for q in quat))
    (tmp_path / "a.splat").write_bytes(record)
    g, stored = load(tmp_path / "a.splat"), [byte - 128 for byte in record[28:]]
    assert g.quats[0].tolist() == pytest.approx(quat, abs=0.005)
    g, stored = replace(g, quats=g.quats / g.quats.norm()), [q / math.hypot(*stored) for q in stored]
    alike(g, 0, [1.5, -2.25, 0.5], stored, [math.log(v) for v in (0.1, 2.0, 0.003)], 0.4, [(c - 0.5) / C0 for c in (1.0, 0.0, 0.2)])
    save(g, tmp_path / "b.splat")
    again = (tmp_path / "b.splat").read_bytes()
    assert again[:12] + again[24:] == record[:12] + record[24:], "but for the last bit of a scale"


def test_harmonics_of_degree_4_in_an_spz_file_are_left_out_and_told(tmp_path, capsys):
    rest = b"".join(bytes([i] * 3) for i in range(24))
    (tmp_path / "a.spz").write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 4, 12, 0, 0) + bytes(20) + rest))
    g = load(tmp_path / "a.spz")
    kept = torch.tensor([(i - 128) / 128 for i in range(15)])
    # turned within each degree, those beyond 3 left out before
    assert all(g.sh[0, a:b, 0].norm() == pytest.approx(float(kept[a - 1 : b - 1].norm())) for a, b in ((1, 4), (4, 9), (9, 16)))
    assert "a.spz has harmonics of degree 4; those beyond degree 3 are left out" in capsys.readouterr().err


def test_spz_versions_hold_the_same_splats(tmp_path):
    g = gaussians(500, 9)
    found = []
    for version in (2, 3, 4):
        save_spz(tmp_path / "a.spz", g, version)
        found.append(load_spz(tmp_path / "a.spz"))
    for other in found[:2]:
        assert all(torch.equal(getattr(other, f), getattr(found[2], f)) for f in ("means", "log_scales", "logit_opacities"))
        assert (other.sh - found[2].sh).abs().max() < 1e-6  # the last bits of turning them are not told
        assert ((other.quats * found[2].quats).sum(1).abs() > 0.99).all()  # version 2 has a byte a term, and w from the rest
    assert torch.equal(found[1].quats, found[2].quats)


def test_spz_positions_far_away_give_up_digits_not_places(tmp_path):
    g = replace(gaussians(100), means=1e5 * gaussians(100).means)
    save(g, tmp_path / "a.spz")
    off = (load(tmp_path / "a.spz").means - g.means).abs().max()
    assert 0 < off <= float(g.means.abs().max()) / 2**22


def test_a_header_that_claims_too_much_allocates_nothing(tmp_path):
    save_spz(tmp_path / "a.spz", gaussians(3), 4)
    data = bytearray((tmp_path / "a.spz").read_bytes())
    data[8:12] = struct.pack("<I", 2**32 - 1)
    (tmp_path / "a.spz").write_bytes(data)
    (tmp_path / "b.spz").write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**32 - 1, 3, 12, 0, 0)))
    for name in ("a.spz", "b.spz"):
        with pytest.raises(ValueError, match="claims 4294967295 splats"):
            load(tmp_path / name)


def test_a_bomb_is_not_unpacked(tmp_path):
    import zstandard

    zeros = zstandard.compress(bytes(10**8))
    data = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 0, 12, 0, 5, 32)
    data += b"".join(struct.pack("<QQ", len(zeros), size) for size in (9, 1, 3, 3, 4)) + zeros * 5
    (tmp_path / "a.spz").write_bytes(data)
    (tmp_path / "b.spz").write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(10**8)))
    for name in ("a.spz", "b.spz"):
        with pytest.raises(ValueError, match="corrupt"):
            load(tmp_path / name)


def test_a_sog_with_few_harmonics_keeps_each_and_with_many_the_near_ones(tmp_path):
    few = gaussians(200, 4)
    few = replace(few, sh=torch.cat([few.sh[:, :1], torch.round(few.sh[:, 1:] * 8) / 8], 1))
    save(few, tmp_path / "few.sog")
    from scenes.formats import SOG

    assert torch.equal(load(tmp_path / "few.sog").sh[:, 1:], SOG.arranged(few).sh[:, 1:])


def test_a_palette_stands_for_its_vectors_better_than_chance():
    dice = np.random.default_rng(0)
    vectors = (dice.normal(size=(20, 6))[dice.integers(20, size=5000)] + 0.01 * dice.normal(size=(5000, 6))).astype(np.float32)
    sets, labels = palette(vectors, 256)
    assert sets.shape == (256, 6) and labels.shape == (5000,)
    assert np.square(vectors - sets[labels]).mean() < 0.001 * vectors.var()
    repeated = vectors[dice.integers(200, size=5000)]
    sets, labels = palette(repeated, 256)
    assert len(sets) <= 200 and np.array_equal(sets[labels], repeated)


def test_what_is_next_to_nothing_does_not_split_a_palette():
    """Turned harmonics leave 1e-17 to 1e-40 for what was 0, no two alike: float32 squares of that are 0, and parts were split to none."""
    chance = np.random.default_rng(0)
    vectors = np.zeros((3000, 9), np.float32)
    vectors[:, :3] = chance.normal(size=(60, 3))[chance.integers(0, 60, 3000)]
    vectors[:, 3:] = 10.0 ** chance.uniform(-40, -17, (3000, 6)) * chance.choice([-1, 1], (3000, 6))
    sets, labels = palette(vectors, 256)
    assert len(sets) <= 256 and np.isfinite(sets).all() and np.abs(sets[labels] - vectors).max() < 1e-6


def test_a_sog_whose_table_has_no_number_is_refused(tmp_path):
    save(gaussians(50, 4), tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as whole, zipfile.ZipFile(tmp_path / "b.sog", "w") as damaged:
        for name in whole.namelist():
            data = whole.read(name)
            meta = json.loads(data) if name == "meta.json" else {}
            if meta:
                meta["shN"]["codebook"][3] = math.nan
                data = json.dumps(meta).encode()
            damaged.writestr(name, data)
    with pytest.raises(ValueError, match=r"b\.sog is corrupt: entry 3 of its shN table is no number"):
        load(tmp_path / "b.sog")


def test_a_codebook_holds_few_values_exactly_and_many_nearly():
    few = np.array([[3.0, -1.5], [3.0, 7.25]], np.float32)
    table = codebook(few)
    assert np.array_equal(table[nearest(table, few)], few)
    many = np.random.default_rng(0).normal(size=20000).astype(np.float32)
    table = codebook(many)
    assert table.shape == (256,) and (np.diff(table) >= 0).all()
    uniform = np.linspace(many.min(), many.max(), 256, dtype=np.float32)
    errors = [np.square(t[nearest(t, many)] - many).mean() for t in (table, uniform)]
    assert errors[0] < errors[1]
