import math
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from randomized import gaussians

from scenes import Gaussians, load, load_dropping, save
from scenes.formats.ply import load_ply, save_ply

DEGREE_1 = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(9)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)
FORMATS = ["binary_little_endian", "binary_big_endian", "ascii"]


def same_bits(a: Gaussians, b: Gaussians) -> bool:
    pairs = zip(a.tensors().values(), b.tensors().values(), strict=True)
    return all(torch.equal(x.view(torch.int32), y.view(torch.int32)) for x, y in pairs)


def write(path, names, rows, kind="float", order="<", fmt="binary_little_endian", count=None, before="", tail=b""):
    """A PLY file made by hand; `rows` `[N, len(names)]`."""
    code = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}[kind]
    header = f"ply\nformat {fmt} 1.0\ncomment made by hand\n{before}element vertex {len(rows) if count is None else count}\n"
    header += "".join(f"property {kind} {n}\n" for n in names) + "end_header\n"
    text = "\n".join(" ".join(repr(float(v)) for v in row) for row in rows)
    body = text.encode() if fmt == "ascii" else rows.astype(order + code).tobytes()
    path.write_bytes(header.encode() + body + tail)


def values(g: Gaussians, names):
    """float32 `[N, len(names)]` as another tool would lay them out."""
    rest = g.sh[:, 1:].transpose(1, 2).reshape(len(g), -1)
    table = {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    for prefix, tensor in (("f_dc", g.sh[:, 0]), ("scale", g.log_scales), ("rot", g.quats)):
        table |= {f"{prefix}_{i}": tensor[:, i] for i in range(tensor.shape[1])}
    table |= {"x": g.means[:, 0], "y": g.means[:, 1], "z": g.means[:, 2], "opacity": g.logit_opacities}
    return np.stack([table.get(n, torch.zeros(len(g))).numpy() for n in names], 1)


@pytest.mark.parametrize("count", [0, 1, 33])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_reading_what_was_written_is_bit_equal(tmp_path, count, coefficients):
    before = gaussians(count, coefficients)
    save_ply(tmp_path / "a.ply", before)
    assert same_bits(load_ply(tmp_path / "a.ply"), before)


def test_negative_zeros_and_denormals_survive(tmp_path):
    g = gaussians(3)
    g.means[0] = torch.tensor([-0.0, 1e-42, 3.4e38])
    save_ply(tmp_path / "a.ply", g)
    assert same_bits(load_ply(tmp_path / "a.ply"), g)


def test_the_bytes_are_those_of_the_reference_code(tmp_path):
    g = gaussians(5, 4)
    save_ply(tmp_path / "a.ply", g)
    properties = "".join(f"property float {n}\n" for n in DEGREE_1)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 5\n{properties}end_header\n"
    assert (tmp_path / "a.ply").read_bytes() == header.encode() + values(g, DEGREE_1).astype("<f4").tobytes()


@settings(max_examples=30)
@given(st.permutations(DEGREE_1), st.sampled_from(["float", "double"]), st.sampled_from(FORMATS))
def test_any_order_type_and_format_reads_the_same(tmp_path_factory, names, kind, fmt):
    path, g = tmp_path_factory.mktemp("ply") / "a.ply", gaussians(4)
    names = [*names[:5], "confidence", *names[5:], "segment"]
    write(path, names, values(g, names), kind, ">" if "big" in fmt else "<", fmt)
    assert same_bits(load_ply(path), g)


def test_mixed_types_and_other_elements_are_skipped(tmp_path):
    g, path = gaussians(4, 1), tmp_path / "a.ply"
    names = [n for n in DEGREE_1 if not n.startswith(("f_rest", "n"))]
    kinds = [("flag", "u1"), *((n, "<f4") for n in names), ("label", "<i2")]
    records = np.zeros(4, kinds)
    for n, column in zip(names, values(g, names).T, strict=True):
        records[n] = column
    spell = {"u1": "uchar", "<f4": "float32", "<i2": "int16"}
    header = "ply\r\nformat binary_little_endian 1.0\r\nelement camera 2\r\nproperty int id\r\nelement vertex 4\r\n"
    header += "".join(f"property {spell[k]} {n}\r\n" for n, k in kinds) + "element extra 1\r\nproperty list uchar int ids\r\nend_header\r\n"
    path.write_bytes(header.encode() + bytes(8) + records.tobytes() + b"\x01\x00\x00\x00\x07")
    assert same_bits(load_ply(path), g)


@pytest.mark.parametrize("fmt", ["binary_little_endian", "ascii"])
def test_every_truncation_is_refused(tmp_path, fmt):
    g, path = gaussians(3), tmp_path / "a.ply"
    write(path, DEGREE_1, values(g, DEGREE_1), fmt=fmt)
    whole = path.read_bytes()
    last = whole.rindex(b" ") if fmt == "ascii" else len(whole) - 1  # a cut inside the last decimal number cannot be seen
    for cut in [*range(0, last, 37), last]:
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match="truncated|corrupt|not a PLY"):
            load_ply(path)


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_giant_claimed_count_allocates_nothing(tmp_path, fmt):
    path = tmp_path / "a.ply"
    for count in (2**31, 2**62, 10**30):
        write(path, DEGREE_1, values(gaussians(2), DEGREE_1), fmt=fmt, count=count)
        with pytest.raises(ValueError, match=f"claims {count} splats"):
            load_ply(path)


def test_a_count_below_what_is_there_is_refused(tmp_path):
    for fmt in ("binary_little_endian", "ascii"):
        write(tmp_path / "a.ply", DEGREE_1, values(gaussians(3), DEGREE_1), fmt=fmt, count=2)
        with pytest.raises(ValueError, match="corrupt.*claims 2 splats"):
            load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    "header, said",
    [
        (b"", "does not start with the line ply"),
        (b"solid cube\n", "does not start with the line ply"),
        (b"ply\n" + b"\x00" * 200, "no end_header"),
        (b"ply\nend_header\n", "no format line"),
        (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "line 2"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quaternion x\nend_header\n", "line 4"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n", "line 5"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n", "is a mesh"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "lack y, z, f_dc_0"),
    ],
)
def test_a_foreign_or_corrupt_header_is_refused(tmp_path, header, said):
    path = tmp_path / "a.ply"
    path.write_bytes(header)
    with pytest.raises(ValueError, match=said) as error:
        load_ply(path)
    assert str(path) in str(error.value)


def test_a_wrong_number_of_sh_properties_is_refused(tmp_path):
    names = [*DEGREE_1, "f_rest_9"]
    write(tmp_path / "a.ply", names, values(gaussians(2), names))
    with pytest.raises(ValueError, match="10 f_rest properties"):
        load_ply(tmp_path / "a.ply")


MEANT = [
    ("logit_opacities", math.inf),
    ("logit_opacities", -math.inf),
    ("log_scales", -math.inf),
]  # tools write opacities and scales of 0, 1


@pytest.mark.parametrize(
    "field, value", [case for case in product(Gaussians.empty().tensors(), [math.nan, math.inf, -math.inf]) if case not in MEANT]
)
def test_a_value_that_is_not_finite_is_refused_by_splat_and_field(tmp_path, field, value):
    g = gaussians(9)
    getattr(g, field)[5] = value
    save_ply(tmp_path / "a.ply", g)
    with pytest.raises(ValueError, match=rf"a.ply: splat 5 has {value} in {field}.*1 such splats"):
        load(tmp_path / "a.ply")
    kept, dropped = load_dropping(tmp_path / "a.ply")
    assert dropped == 1 and same_bits(kept, g.select(torch.arange(9) != 5))


def test_a_quaternion_of_length_zero_is_refused(tmp_path):
    g = gaussians(4)
    g.quats[2] = 0
    save_ply(tmp_path / "a.ply", g)
    with pytest.raises(ValueError, match="splat 2 has a quaternion of length zero"):
        load(tmp_path / "a.ply")


def test_saving_refuses_what_loading_would_refuse(tmp_path):
    g = gaussians(4)
    g.means[1, 2] = float("nan")
    for name in ("a.ply", "a.usdc"):
        with pytest.raises(ValueError, match="splat 1 has nan in means"):
            save(g, tmp_path / name)
    assert not list(tmp_path.iterdir())


@settings(max_examples=150)
@given(st.binary(max_size=300), st.integers(0, 700), st.booleans())
def test_damaged_files_never_do_worse_than_a_value_error(tmp_path_factory, noise, where, keep_length):
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    write(path, DEGREE_1, values(gaussians(2), DEGREE_1))
    whole = path.read_bytes()
    path.write_bytes(whole[:where] + noise + whole[where + (len(noise) if keep_length else 0) :])
    try:
        assert len(load_ply(path)) <= 3
    except ValueError as error:
        assert str(path) in str(error)


def test_a_comment_may_hold_the_word_that_ends_a_header(tmp_path):
    save_ply(tmp_path / "a.ply", gaussians())
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"element vertex", b"comment up to end_header it says\nelement vertex", 1))
    assert same_bits(load_ply(tmp_path / "a.ply"), load_ply(tmp_path / "b.ply"))
