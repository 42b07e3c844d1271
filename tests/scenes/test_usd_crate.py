"""USD's binary files: what they claim is held against what they are."""

import pytest
from randomized import gaussians, scene

from scenes import load, save
from scenes.usd.crate import _lz4, check_crate


@pytest.fixture
def crate(tmp_path):
    save(gaussians(50), tmp_path / "a.usdc")
    return tmp_path / "a.usdc"


def test_what_usd_writes_passes(crate, tmp_path):
    check_crate(crate)
    save(scene(), tmp_path / "s1")
    files = sorted((tmp_path / "s1").rglob("*.usd*"))
    assert len(files) > 4
    for file in files:
        check_crate(file)
    (tmp_path / "a.txt").write_text("hello")
    check_crate(tmp_path / "a.txt")


@pytest.mark.parametrize("claim", [10**4, 2**31, 2**60])
def test_an_array_that_claims_more_than_the_file_is_refused(crate, claim):
    data = bytearray(crate.read_bytes())
    at = data.index(gaussians(50).means.numpy().tobytes()) - 8
    assert int.from_bytes(data[at : at + 8], "little") == 50
    data[at : at + 8] = claim.to_bytes(8, "little")
    crate.write_bytes(data)
    with pytest.raises(ValueError, match=rf"a.usdc is not a valid USD file: an array claims {claim} values of 12 bytes"):
        load(crate)


def test_every_section_is_held_to_its_size(crate):
    whole = crate.read_bytes()
    table = int.from_bytes(whole[16:24], "little")
    for i in range(int.from_bytes(whole[table : table + 8], "little")):
        entry = table + 8 + 32 * i
        start = int.from_bytes(whole[entry + 16 : entry + 24], "little")
        for at in (start, entry + 16, entry + 24):
            crate.write_bytes(whole[:at] + (2**61).to_bytes(8, "little") + whole[at + 8 :])
            with pytest.raises(ValueError, match="a.usdc is not a valid USD file: it"):
                load(crate)


def test_lz4_blocks_are_unpacked_as_their_page_says():
    assert _lz4(bytes([0x80]) + b"abcdefgh", 8) == b"abcdefgh"  # plain bytes alone
    assert _lz4(bytes([0x11]) + b"a" + bytes([1, 0]) + bytes([0x20]) + b"yz", 8) == b"aaaaaayz"  # a piece that reaches into itself
    long = bytes(range(256)) * 2
    assert _lz4(bytes([0xF0, 255, 512 - 15 - 255]) + long, 512) == long
    for broken in (bytes([0x11]) + b"a" + bytes([2, 0]), bytes([0x11]) + b"a" + bytes([0, 0]), bytes([0x10]) + b"a"):
        with pytest.raises(ValueError, match="packed wrongly"):
            _lz4(broken, 8)
