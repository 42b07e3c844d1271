"""What bends: lattices of displacements, what scenes, edits and files make of them."""

from dataclasses import replace

import pytest
import torch
from pxr import Usd
from street import START_US, STEP_US, box, car, street

from scenes import Actor, Deformation, Lattice, Scene, load, save
from scenes.edit import Edit, edited
from scenes.report import describe, summary
from scenes.usd.edit import add_change
from scenes.usd.layers import usd_problems
from scenes.usd.undo import undo

CORNERS = torch.tensor([[-3.0, -1.0, 0.0], [3.0, 1.0, 2.0]])


def leaning(metres=1.0) -> torch.Tensor:
    """Nodes of a lattice that moves what stands at z by `metres` z / 2 forward."""
    nodes = torch.zeros(2, 3, 2, 3)
    nodes[:, :, 1, 0] = metres
    return nodes


def sways(times=9) -> Deformation:
    dice = torch.Generator().manual_seed(3)
    modes = torch.stack([leaning(), torch.randn(2, 3, 2, 3, generator=dice)])
    return Deformation(CORNERS, modes, START_US + STEP_US * torch.arange(times), torch.randn(times, 2, generator=dice))


def bending() -> Scene:
    """The street with a car that bends."""
    scene = street()
    return replace(scene, actors=(replace(scene.actors[0], deformation=sways()), Actor(car("van"), scene.actors[0].trajectory, "veh_2")))


def test_a_lattice_on_a_gpu_is_the_same():
    dice = torch.Generator().manual_seed(5)
    lattice = Lattice(CORNERS, torch.randn(2, 3, 4, 3, generator=dice))
    points = CORNERS[0] + torch.rand(200, 3, generator=dice) * 1.4 * (CORNERS[1] - CORNERS[0]) - 0.5
    places = 2 * (points - CORNERS[0]) / (CORNERS[1] - CORNERS[0]) - 1
    torch.testing.assert_close(lattice._by_hats(places), lattice.at(points), atol=1e-5, rtol=1e-5)


def test_what_bends_stands_as_in_the_middle_of_a_readout():
    scene = bending()
    actor = scene.actors[0]
    for readout_us in (0, 50_000, -50_000):
        bent = scene.placed(START_US + STEP_US, readout_us)[1]
        leans = actor.deformation.at(START_US + STEP_US + readout_us // 2).at(actor.asset.gaussians.means)
        torch.testing.assert_close(bent.gaussians.means - actor.asset.gaussians.means, leans, atol=1e-5, rtol=0)


def test_a_lattice_is_linear_between_nodes_and_held_beyond():
    points = torch.tensor([[0.3, 0.2, 0.5], [-2.0, 0.9, 2.0], [9.0, -4.0, 7.0], [0.0, 0.0, -3.0]])
    moved = Lattice(CORNERS, leaning()).at(points)
    torch.testing.assert_close(moved, torch.tensor([[0.25, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]]))


def test_axes_of_a_lattice_are_not_mixed_up():
    nodes = torch.zeros(3, 4, 5, 3)
    nodes[2, 1, 3] = torch.tensor([1.0, 2.0, 3.0])
    place = CORNERS[0] + (CORNERS[1] - CORNERS[0]) * torch.tensor([2 / 2, 1 / 3, 3 / 4])
    torch.testing.assert_close(Lattice(CORNERS, nodes).at(place[None])[0], torch.tensor([1.0, 2.0, 3.0]))


def test_where_a_point_came_from_is_found():
    lattice = sways().at(START_US + 130_000)
    lattice = replace(lattice, nodes=0.2 * lattice.nodes)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * (CORNERS[1] - CORNERS[0]) + CORNERS[0]
    torch.testing.assert_close(lattice.origin(points + lattice.at(points)), points, atol=2e-3, rtol=0)


def test_weights_are_linear_between_times_and_held_beyond():
    d = sways()
    half = d.at(START_US + STEP_US // 2).nodes
    torch.testing.assert_close(half, (d.at(START_US).nodes + d.at(START_US + STEP_US).nodes) / 2)
    assert torch.equal(d.at(START_US - 5 * STEP_US).nodes, d.at(START_US).nodes)
    assert torch.equal(d.at(START_US + 50 * STEP_US).nodes, d.at(START_US + 8 * STEP_US).nodes)


def test_gradients_reach_modes_and_weights():
    d = sways()
    d = replace(d, modes=d.modes.requires_grad_(), weights=d.weights.requires_grad_())
    d.at(START_US + 10).at(torch.tensor([[0.1, 0.2, 1.0]])).square().sum().backward()
    assert d.modes.grad is not None and d.modes.grad.any() and d.weights.grad[:2].any() and not d.weights.grad[2:].any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"corners": CORNERS.flip(0)}, "corners must be the least and the largest"),
        ({"modes": torch.zeros(2, 1, 3, 2, 3)}, "modes must have at least 2 nodes along each axis"),
        ({"weights": torch.zeros(9, 3)}, r"weights must have shape \(9, 2\)"),
        ({"times_us": torch.tensor([0, 1, 2, 3, 4, 4, 6, 7, 8])}, "times_us must rise strictly, but entry 5 does not"),
    ],
)
def test_what_does_not_fit_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        replace(sways(), **change)


def test_a_scene_places_what_bends_as_it_is_then():
    scene, time = bending(), START_US + 230_000
    _, bent, stiff = scene.placed(time)
    means = scene.actors[0].asset.gaussians.means
    torch.testing.assert_close(bent.gaussians.means, means + scene.actors[0].deformation.at(time).at(means))
    assert not torch.equal(bent.gaussians.means, means) and bent.lattice is not None
    assert stiff.gaussians is scene.actors[1].asset.gaussians and stiff.lattice is None


def same(a: Deformation | None, b: Deformation | None) -> bool:
    names = ("corners", "modes", "times_us", "weights")
    return a is b is None or (a is not None and b is not None and all(torch.equal(getattr(a, n), getattr(b, n)) for n in names))


def test_a_deformation_returns_from_a_scenes_folder(tmp_path):
    save(bending(), tmp_path / "s1")
    back = load(tmp_path / "s1")
    assert same(back.actors[0].deformation, sways()) and back.actors[1].deformation is None
    assert usd_problems(tmp_path / "s1" / "scene.usda") == []
    stage = Usd.Stage.Open(str(tmp_path / "s1" / "scene.usda"))
    weights = stage.GetPrimAtPath("/World/Actors/veh_1").GetAttribute("sidestep:deformation:weights")
    between = sways().weights[:2].mean(0).tolist()
    assert list(weights.Get(STEP_US / 2)) == pytest.approx(between, rel=1e-6)  # USD itself says the same between samples


def test_a_deformation_that_is_not_finite_is_not_written(tmp_path):
    scene = bending()
    bad = replace(sways(), weights=torch.full((9, 2), torch.nan))
    with pytest.raises(ValueError, match="actor veh_1: its deformation has weights that are not finite"):
        save(replace(scene, actors=(replace(scene.actors[0], deformation=bad),)), tmp_path / "s1")


def test_info_tells_of_it(tmp_path):
    save(bending(), tmp_path / "s1")
    told = describe(tmp_path / "s1")
    assert told["actors"][0]["modes"] == 2 and "modes" not in told["actors"][1]
    assert any("modes" in line for line in summary(told))


@pytest.mark.parametrize("edit", [Edit(retime={"veh_1": 300_000}), Edit(shift={"veh_1": (1.0, 0.5)}), Edit(replace={"veh_1": car("van")})])
def test_edits_keep_what_bends_in_step_with_its_path(tmp_path, edit):
    save(bending(), tmp_path / "s1")
    add_change(tmp_path / "s1", "mine", load(tmp_path / "s1"), edit, {})
    after, made = load(tmp_path / "s1").actors[0], edited(bending(), edit).actors[0]
    assert same(after.deformation, made.deformation)
    if edit.replace:
        assert after.deformation is None
    else:
        later = edit.retime.get("veh_1", 0)
        time = START_US + 250_000
        assert torch.equal(after.deformation.at(time + later).nodes, sways().at(time).nodes)


def test_a_replaced_actor_that_is_put_back_bends_again(tmp_path):
    save(bending(), tmp_path / "s1")
    add_change(tmp_path / "s1", "mine", load(tmp_path / "s1"), Edit(replace={"veh_1": car("van")}), {})
    (tmp_path / "s1" / "edits" / "mine.usda").unlink()
    assert same(load(tmp_path / "s1").actors[0].deformation, sways())


@pytest.mark.parametrize("first", [Edit(replace={"veh_1": car("van")}), Edit(retime={"veh_1": 200_000})], ids=["replace", "retime"])
@pytest.mark.parametrize("second", [Edit(retime={"veh_1": 300_000}), Edit(shift={"veh_1": (1.0, 0.5)})], ids=["retime", "shift"])
def test_what_an_edit_moved_bends_in_step_when_the_edit_before_is_undone(tmp_path, first, second):
    save(bending(), tmp_path / "s1")
    add_change(tmp_path / "s1", "first", load(tmp_path / "s1"), first, {})
    add_change(tmp_path / "s1", "second", load(tmp_path / "s1"), second, {})
    assert (load(tmp_path / "s1").actors[0].deformation is None) == bool(first.replace)
    undo(tmp_path / "s1", "first")
    actor = load(tmp_path / "s1").actors[0]
    later = int(actor.trajectory.times_us[0] - bending().actors[0].trajectory.times_us[0])
    assert later == sum(e.retime.get("veh_1", 0) for e in (first, second)) and same(actor.deformation, sways().later(later))


def test_a_file_whose_numbers_do_not_fit_is_refused(tmp_path):
    save(bending(), tmp_path / "s1")
    file = tmp_path / "s1" / "recorded.usda"
    text = file.read_text()
    assert "[2, 2, 3, 2]" in text
    file.write_text(text.replace("[2, 2, 3, 2]", "[2, 2, 3, 4]"))
    with pytest.raises(ValueError, match="veh_1 has a deformation whose numbers do not fit"):
        load(tmp_path / "s1")


def test_moving_a_scene_to_a_device_takes_it_along():
    moved = bending().to("meta").actors[0].deformation
    assert moved.modes.device.type == "meta" and moved.times_us.device.type == "cpu"


def test_a_box_that_leans_stays_on_its_feet():
    splats = box((1.0, 0.6, 2.0), (0.5, 0.5, 0.5))
    moved = splats.means + Lattice(CORNERS, leaning(0.4)).at(splats.means)
    low = splats.means[:, 2] < 1e-4
    torch.testing.assert_close(moved[low], splats.means[low], atol=1e-4, rtol=0)
