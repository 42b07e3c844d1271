"""What the table of the training's parts stands on."""

import torch
from small_net import stirred

from enhance.enhancer import Enhancer
from enhance.network.weights_file import REPAIR_GAIN
from enhance.pairs.shards import KINDS, PairSet, to_bytes, write_shard
from tests.bench.ablate import CONFIG, Alone, halved, suited, table, variants
from tests.bench.nafnet import NafNet


def test_an_untrained_nafnet_changes_nothing_and_is_as_large_as_ours():
    net, rgb = NafNet(), torch.rand(1, 3, 32, 48)
    assert torch.equal(net(rgb, torch.zeros(1, 2, 32, 48)), rgb)
    assert abs(sum(p.numel() for p in net.parameters()) / 4.31e6 - 1) < 0.05


def test_every_rows_network_repairs_what_is_rendered_and_nothing_else():
    enhancer = Enhancer(stirred(), {REPAIR_GAIN: [0.0, 0.0]}, repair=True)
    for of in (enhancer, Alone(enhancer)):
        shown = [suited(of, kind) for kind in ("sparse", "clean")]
        inside = [getattr(s, "enhancer", s).repairs for s in shown]
        assert all(inside[0]) and not any(inside[1]) and type(shown[1]) is type(of)
    assert suited(None, "clean") is None


def test_every_row_leaves_out_one_thing():
    rows = variants(["isp", "clean"])
    assert rows["the whole"].config.kinds == ("isp", "clean") and rows["without isp"].config.kinds == ("clean",)
    for name, row in rows.items():
        changed = sum(getattr(row.config, field) != getattr(CONFIG, field) for field in ("perceptual", "temporal", "frames"))
        left_out = (not row.prior) + (len(row.config.kinds) == 1) + changed
        assert left_out == (name != "the whole"), name


def test_halved_clips_move_half_as_far(tmp_path):
    flow = torch.full((2, 32, 48, 2), 3.0, dtype=torch.float16)
    flow[0] = torch.nan
    picture = to_bytes(torch.rand(2, 32, 48, 3))
    bytes_ = torch.ones(2, 32, 48, dtype=torch.uint8)
    tensors = {
        "input": picture,
        "target": picture.clone(),
        "region": bytes_ * 255,
        "instance": bytes_ * 255,
        "flow": flow,
        "visible": bytes_,
    }
    for name in ("a", "b", "c"):
        meta = {"kind": "clean", "split": "train", "name": name}
        write_shard(tmp_path / "in" / "clean" / f"{name}.safetensors", tensors | {"depth": flow[..., 0]}, meta)
    small = halved(PairSet(tmp_path / "in"), tmp_path / "out").of("clean", "train")
    assert [s.meta["name"] for s in small] == ["a", "c"] and (small[0].height, small[0].width) == (16, 24)
    w = small[0].window()
    assert (w.flow[1] == 1.5).all() and (w.visible[1] == 1).all() and (w.instance == -1).all() and (w.region == 1).all()


def test_the_table_has_a_column_for_every_kind():
    text = table({"identity": {kind: [float("inf") if kind == "clean" else 20.0, 1.0] for kind in KINDS}}, list(KINDS))
    assert "equal / 1.00" in text and all(line.count("|") == len(KINDS) + 2 for line in text.splitlines())
