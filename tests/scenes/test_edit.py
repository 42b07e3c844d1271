"""Edits of actors: what they do to a scene in memory, and that their layers say the same to Sidestep and to USD."""

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from edited_street import ALL, VAN, busy, parking, same, shown
from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt
from street import START_US, car, street

from scenes import Actor, Ground, Scene, Trajectory, load, save, validate
from scenes.astray import astray, meeting
from scenes.edit import HIDDEN, Edit, absences, edited
from scenes.harmonics import rgb_from_sh, sh_from_rgb
from scenes.insert import insert
from scenes.match import ground_linear
from scenes.placement import Placement
from scenes.poses import inverse, translation, yaw
from scenes.seen import SECTORS
from scenes.standing import standing_pose
from scenes.usd.edit import add_change, add_edit
from scenes.usd.layers import new_stage, usd_problems
from scenes.usd.root import RECORDED, add_sublayer
from scenes.usd.undo import undo


@pytest.fixture
def saved(tmp_path):
    save(busy(), tmp_path / "s1")
    return tmp_path / "s1"


def test_an_edit_on_disk_does_what_it_does_in_memory(saved):
    add_change(saved, "mine", load(saved), ALL, {"kind": "edit"})
    after = load(saved)
    same(after, edited(busy(), ALL))
    assert [a.asset.meta.get("edited") for a in after.actors] == ["mine", "mine"]
    assert after.meta["edits"] == [{"kind": "edit", "remove": ["veh_1"], "name": "mine"}]


def test_an_edit_is_undone_by_deleting_its_layer_and_tidied_up_by_undo(saved):
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    add_change(saved, "mine", load(saved), ALL, {})
    assert {p for p, data in before.items() if p.read_bytes() != data} == {saved / "scene.usda"}
    (saved / "edits" / "mine.usda").unlink()
    same(load(saved), busy())
    (problem,) = [p for p in validate(saved) if "not tidied up" in p]
    assert f"sidestep edit {saved} --undo mine" in problem
    undo(saved, "mine")
    assert validate(saved) == []
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before
    with pytest.raises(ValueError, match='edit "mine" is not in'):
        undo(saved, "mine")
    with pytest.raises(ValueError, match="--undo mine --undo more$"):
        undo(saved, "mine,more")


def test_usds_validators_find_nothing_in_an_edited_scene(saved):
    add_change(saved, "mine", load(saved), ALL, {})
    add_edit(saved, "more", [Actor(VAN, Trajectory(torch.tensor([0]), translation(9.0)[None]), "new")], {})
    assert validate(saved) == []
    for file in [*saved.rglob("*.usda"), *saved.rglob("*.usdc")]:
        assert usd_problems(file) == [], file


def test_usd_sees_what_sidestep_sees(saved):
    add_change(saved, "mine", load(saved), ALL, {})
    stage = Usd.Stage.Open(str(saved / "scene.usda"))
    assert not stage.GetPrimAtPath("/World/Actors/veh_1").IsActive()
    moved, retimed = stage.GetPrimAtPath("/World/Actors/veh_2"), 400_000 + 300_000
    assert list(UsdGeom.XformCache(retimed).GetLocalToWorldTransform(moved).ExtractTranslation()) == pytest.approx([11.0, -1.5, 0.0])
    assert UsdGeom.Imageable(moved).ComputeVisibility(0) == "invisible"
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Background/Gaussians"))
    assert sum(v == 0 for v in splats.GetOpacitiesAttr().Get()) > 100


def test_removing_an_actor_leaves_no_ghost_and_harms_nothing_else():
    scene = busy()
    logits = edited(scene, Edit(remove=("veh_2",))).background.gaussians.logit_opacities
    hidden, means = logits == HIDDEN, scene.background.gaussians.means
    ghost = torch.arange(len(means)) >= len(street().background.gaussians)
    assert hidden[ghost].all() and not hidden[~ghost].any()
    assert (means[hidden][:, 2] > 0.2).all()


def test_what_a_fast_actor_left_between_two_of_its_poses_goes_too():
    scene = busy()
    fast = Trajectory(START_US + 1_000_000 * torch.arange(2), torch.stack([translation(5.0, -3.0), translation(15.0, -3.0)]))
    (actor,) = [a for a in scene.actors if a.track == "veh_2"]
    scene = replace(scene, actors=(replace(actor, trajectory=fast),))
    logits = edited(scene, Edit(remove=("veh_2",))).background.gaussians.logit_opacities
    assert (logits[len(street().background.gaussians) :] == HIDDEN).all()


def elsewhere(scene: Scene) -> Scene:
    """The same with a background that stands in a frame of its own."""
    pose, g = translation(40.0, -7.0, 1.0) @ yaw(2.0), scene.background.gaussians
    back = inverse(pose)
    means = (g.means.double() @ back[:3, :3].T + back[:3, 3]).float()
    return replace(scene, background=replace(scene.background, gaussians=replace(g, means=means), world_from_local=pose))


def test_it_does_not_matter_in_which_frame_the_background_stands():
    """What lies behind the parked car, as seen from the path's end, is red, which does not tell how it looks below it."""
    scene = parking()
    g, passed = scene.background.gaussians, scene.ego.world_from_body[-1, :3, 3].float()
    behind = (g.means - passed).norm(dim=1) > (torch.tensor([20.0, -7.0, 0.0]) - passed).norm()
    sh = torch.where(behind[:, None, None], sh_from_rgb(torch.tensor([1.0, 0.0, 0.0])), g.sh)
    scene = replace(scene, background=replace(scene.background, gaussians=replace(g, sh=sh)))
    edit = Edit(remove=("veh_2", "veh_7"))
    here, there = (edited(s, edit).background.gaussians for s in (scene, elsewhere(scene)))
    hidden = here.logit_opacities == HIDDEN
    assert hidden.sum() > 200 and (hidden ^ (there.logit_opacities == HIDDEN)).sum() < 0.02 * hidden.sum()
    painted = (here.sh != sh).flatten(1).any(1) & (there.sh != sh).flatten(1).any(1)
    assert painted.sum() > 10 and (here.sh - there.sh)[painted].abs().max() < 0.2
    rgb = rgb_from_sh(there.sh[painted, 0])
    assert (rgb[:, 0] - rgb[:, 1]).abs().max() < 0.1
    place = torch.tensor([12.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(ground_linear(elsewhere(scene), place), ground_linear(scene, place), atol=1e-3, rtol=0)
    driven = insert(scene, car(), Placement("car/0001", 14.0, -7.0, speed=8.0))
    assert "runs into veh_7" in driven.warnings[-1]
    assert insert(elsewhere(scene), car(), Placement("car/0001", 14.0, -7.0, speed=8.0)).warnings == driven.warnings


@pytest.mark.parametrize("edit", [Edit(remove=("veh_1",)), Edit(shift={"inserted_car_0001": (0.0, 3.0)})], ids=["shifted", "inserted"])
def test_where_an_actor_only_virtually_stood_nothing_is_hidden(edit):
    """Both stand where veh_2 left its ghost, which is as real as a wall to them."""
    scene = edited(busy(), Edit(shift={"veh_1": (8.0, 5.5)}))
    scene = insert(scene, car(), Placement("car/0001", 10.0, -3.0)).scene
    before, after = (s.background.gaussians.logit_opacities for s in (scene, edited(scene, edit)))
    assert torch.equal(after, before)


def test_a_parked_vehicle_is_removed_from_the_background_and_comes_back(tmp_path):
    scene = parking()
    save(scene, tmp_path / "s1")
    add_change(tmp_path / "s1", "mine", load(tmp_path / "s1"), Edit(remove=("veh_7",)), {})
    after = load(tmp_path / "s1")
    same(after, edited(scene, Edit(remove=("veh_7",))))
    assert after.meta["parked"] == [] == edited(scene, Edit(remove=("veh_7",))).meta["parked"]
    with pytest.raises(ValueError, match="veh_7 is not in street any more: the edit mine removed it"):
        add_change(tmp_path / "s1", "again", after, Edit(remove=("veh_7",)), {})
    hidden = edited(scene, Edit(remove=("veh_7",))).background.gaussians.logit_opacities == HIDDEN
    own = torch.arange(len(hidden)) >= len(busy().background.gaussians)
    assert (hidden[own] | (scene.background.gaussians.means[own][:, 2] <= 0.08)).all() and not hidden[~own].any()
    undo(tmp_path / "s1", "mine")
    same(load(tmp_path / "s1"), scene)
    assert load(tmp_path / "s1").meta["parked"] == scene.meta["parked"]


@pytest.mark.parametrize(("by", "said"), [(5.0, []), (30.0, ["13.5 m"]), (1e30, ["1e+30 m"])])
def test_it_is_said_when_an_actor_is_shifted_off_the_known_ground(by, said):
    told = astray(Edit(shift={"veh_1": (0.0, -by), "veh_2": (1.0, 0.0)}), busy())
    assert [f"veh_1 is shifted {far} beyond the known ground and keeps the height of its edge there" for far in said] == told


@pytest.mark.parametrize(("by", "said"), [(0, None), (300_000, "0.2s to 1.1s only"), (20_000_000, "of a drive of 0.8s: never")])
def test_it_is_said_when_an_actor_leaves_the_drives_time(by, said):
    told = absences(Edit(retime={"veh_2": by}), busy())
    assert told == [] if said is None else said in told[0]


def test_the_street_below_a_removed_parked_vehicle_looks_as_beside_it(tmp_path):
    """The fit paints there what it could not explain by the vehicle; red here."""
    scene = parking()
    g = scene.background.gaussians
    at = g.means - torch.tensor([20.0, -7.0, 0.0])
    street_there = (at[:, 0].abs() < 2.1) & (at[:, 1].abs() < 0.9) & (at[:, 2].abs() < 0.05)
    sh = g.with_sh_count(4).sh.clone()
    sh[:, 1:] = 0.1
    sh[street_there, 0] = sh_from_rgb(torch.tensor([1.0, 0.0, 0.0]))
    scene = replace(scene, background=replace(scene.background, gaussians=replace(g, sh=sh)))
    save(scene, tmp_path / "s1")
    add_change(tmp_path / "s1", "mine", load(tmp_path / "s1"), Edit(remove=("veh_7",)), {})
    after = edited(scene, Edit(remove=("veh_7",)))
    same(load(tmp_path / "s1"), after)
    torch.testing.assert_close(load(tmp_path / "s1").background.gaussians.sh, after.background.gaussians.sh)
    rgb = rgb_from_sh(after.background.gaussians.sh[:, 0])
    assert street_there.sum() > 10 and (rgb[street_there] - rgb[street_there].mean(1, keepdim=True)).abs().max() < 0.05
    changed = (after.background.gaussians.sh != sh).flatten(1).any(1)
    assert (at[changed, :2].abs() <= torch.tensor([2.1, 0.9]) + 0.26).all() and (at[changed, 2] < 0.09).all()
    assert torch.equal(edited(scene, Edit(remove=("veh_1",))).background.gaussians.sh, sh), "below what moves it is seen"
    undo(tmp_path / "s1", "mine")
    same(load(tmp_path / "s1"), scene)


def test_a_parked_vehicle_can_only_be_removed():
    with pytest.raises(ValueError, match="veh_7 is parked.*it can be removed, and another asset inserted"):
        edited(parking(), Edit(shift={"veh_7": (1.0, 0.0)}))
    assert edited(parking(), Edit(remove=("veh_7",))).meta["parked"] == []


def test_another_asset_takes_on_the_light_of_the_place_as_an_inserted_one_does(saved):
    dark = replace(VAN, meta={**VAN.meta, "id": "van/0001", "ground_linear": [0.03, 0.04, 0.05]})
    add_change(saved, "mine", load(saved), Edit(replace={"veh_3": dark}), {})
    put_in = insert(load(saved), dark, Placement("van/0001", 15.0, 5.0)).actor.asset
    for asset in (load(saved).actors[2].asset, edited(busy(), Edit(replace={"veh_3": dark})).actors[2].asset):
        assert asset.meta["light_gain"] == put_in.meta["light_gain"] and asset.meta["id"] == "van/0001"
        assert len(asset.gaussians) == len(VAN.gaussians) and rgb_from_sh(asset.gaussians.sh[:, 0]).mean() > 0.7
    undo(saved, "mine")
    same(load(saved), busy())


def test_what_was_put_in_is_still_known_for_it_when_it_is_shifted_with_all_the_detail_of_its_databank():
    new = insert(busy(), VAN, Placement("van/0001", 15.0, 5.0))
    after = Edit(shift={new.actor.track: (1.0, 0.0)}, originals={new.actor.track: VAN}).apply(new.actor, new.scene)
    assert after.asset.meta["inserted"] and not after.recorded


@pytest.mark.parametrize("brought", ["inserted", "replacing", "retimed"])
def test_an_inserted_or_replacing_asset_takes_on_the_light_of_where_it_is_shifted_or_retimed_to(tmp_path, brought):
    """The street is half as bright from x = 40 on."""
    scene = busy()
    g = scene.background.gaussians
    dark = replace(g, sh=torch.where((g.means[:, :1] > 40)[..., None], sh_from_rgb(rgb_from_sh(g.sh) * 0.7), g.sh))
    scene = replace(scene, background=replace(scene.background, gaussians=dark))
    save(scene, tmp_path / "s1")
    lit = replace(VAN, meta={"id": "van/0001", "ground_linear": [0.15, 0.15, 0.15]})
    if brought == "replacing":
        add_change(tmp_path / "s1", "put", load(tmp_path / "s1"), Edit(replace={"veh_3": lit}), {})
        edit = Edit(shift={"veh_3": (35.0, 0.0)}, originals={"veh_3": lit})
    else:
        new = insert(load(tmp_path / "s1"), lit, Placement("van/0001", 15.0, 5.0, speed=100.0 * (brought == "retimed"))).actor
        add_edit(tmp_path / "s1", "put", [new], {})
        edit = Edit(shift={new.track: (35.0, 0.0)}) if brought == "inserted" else Edit(retime={new.track: -400_000})
    put = load(tmp_path / "s1")
    (was,) = [a for a in put.actors if not a.recorded]
    there = insert(put, lit, Placement("van/0001", 50.0, 5.0)).actor.asset if brought != "retimed" else None
    add_change(tmp_path / "s1", "later", put, edit, {})
    for after in (load(tmp_path / "s1"), edited(put, edit)):
        (asset,) = [a.asset for a in after.actors if not a.recorded]
        assert rgb_from_sh(asset.gaussians.sh[:, 0]).mean() < 0.85 * rgb_from_sh(was.asset.gaussians.sh[:, 0]).mean()
        assert there is None or torch.allclose(asset.gaussians.sh, there.gaussians.sh, atol=0.02)
    undo(tmp_path / "s1", "later")
    same(load(tmp_path / "s1"), put)
    assert torch.equal(next(a for a in load(tmp_path / "s1").actors if not a.recorded).asset.gaussians.sh, was.asset.gaussians.sh)


def test_a_scene_of_before_whose_edits_hold_all_opacities_still_loads(saved):
    """As Sidestep wrote them before an edit held only what it hides."""
    (saved / "edits" / "old").mkdir()
    hidden = torch.arange(len(busy().background.gaussians)) % 3 == 0
    with new_stage(saved / "edits" / "old" / "hidden.usdc", "World") as layer:
        layer.OverridePrim("/World")
        splats = layer.OverridePrim("/World/Background/Gaussians")
        values = Vt.FloatArray.FromNumpy(torch.where(hidden, 0.0, 0.5).numpy())
        splats.CreateAttribute("opacities", Sdf.ValueTypeNames.FloatArray, False).Set(values)
    with new_stage(saved / "edits" / "old.usda", "World") as layer:
        layer.OverridePrim("/World")
        layer.GetRootLayer().subLayerPaths = ["./old/hidden.usdc"]
    add_sublayer(saved, "./edits/old.usda")
    assert torch.equal(shown(load(saved)), ~hidden)
    add_change(saved, "new", load(saved), Edit(remove=("veh_2",)), {})
    assert torch.equal(shown(load(saved)), ~hidden & shown(edited(busy(), Edit(remove=("veh_2",)))))
    undo(saved, "old")
    assert torch.equal(shown(load(saved)), shown(edited(busy(), Edit(remove=("veh_2",)))))


def test_what_was_inserted_can_be_shifted_and_keeps_its_instance(saved):
    for track in ("a", "b"):
        add_edit(saved, track, [Actor(VAN, Trajectory(torch.tensor([0]), translation(9.0)[None]), track)], {})
    add_change(saved, "shift", load(saved), Edit(shift={"a": (2.0, 0.0)}), {})
    after = load(saved)
    assert [a.track for a in after.actors][-2:] == ["a", "b"]
    assert float(after.actors[-2].trajectory.world_from_body[0, 0, 3]) == 11.0


def test_a_shifted_actor_stays_on_the_ground():
    slope = Ground((0.1 * torch.arange(-20.0, 20.0))[:, None].expand(40, 60).contiguous(), (-10.0, -20.0), 1.0)
    scene = replace(busy(), ground=slope)
    after = edited(scene, Edit(shift={"veh_2": (0.0, 2.0)})).actors[1].trajectory
    torch.testing.assert_close(after.world_from_body[:, 2, 3], torch.full((9,), 0.2, dtype=torch.float64), atol=1e-6, rtol=0)


def test_a_shifted_actor_tilts_as_much_more_as_the_ground_does():
    crowned = Ground((-0.04 * torch.arange(-20.0, 20.0).abs())[:, None].expand(40, 60).contiguous(), (-10.0, -20.0), 1.0)
    scene = replace(busy(), ground=crowned)
    was, after = (s.actors[1].trajectory.world_from_body for s in (scene, edited(scene, Edit(shift={"veh_2": (0.0, 6.0)}))))
    assert torch.allclose(after[:, 1, 3], was[:, 1, 3] + 6) and torch.allclose(after[:, 2, 3], was[:, 2, 3], atol=1e-6)
    assert after[:, 2, 1].tolist() == pytest.approx([-math.sin(2 * math.atan(0.04))] * 9, abs=1e-6)


def test_an_actor_that_leans_with_a_slope_climbs_it_once():
    slope = Ground((0.1 * torch.arange(-20.0, 20.0))[:, None].expand(40, 60).contiguous(), (-10.0, -20.0), 1.0)
    scene = replace(busy(), ground=slope)
    actor = scene.actors[1]
    poses = torch.stack([standing_pose(scene, pose[:2, 3], 0.0, actor.asset.size) for pose in actor.trajectory.world_from_body])
    leaning = replace(actor, trajectory=replace(actor.trajectory, world_from_body=poses))
    scene = replace(scene, actors=(scene.actors[0], leaning))
    after = edited(scene, Edit(shift={"veh_2": (0.0, 4.0)})).actors[1].trajectory.world_from_body
    torch.testing.assert_close(after[:, 2, 3], slope.height(after[:, :2, 3]), atol=1e-6, rtol=0)


def test_an_actor_on_a_bridge_is_shifted_along_the_bridge():
    slope = Ground((0.1 * torch.arange(-20.0, 20.0) - 6)[:, None].expand(40, 60).contiguous(), (-10.0, -20.0), 1.0)
    after = edited(replace(busy(), ground=slope), Edit(shift={"veh_2": (0.0, 2.0)})).actors[1].trajectory
    torch.testing.assert_close(after.world_from_body, busy().actors[1].trajectory.shifted(lateral=2.0).world_from_body, atol=1e-9, rtol=0)


def test_a_scene_whose_root_held_the_recording_can_be_edited(saved):
    """As Sidestep wrote scenes before edits could outweigh them."""
    (saved / RECORDED).replace(saved / "scene.usda")
    same(load(saved), busy())
    add_change(saved, "mine", load(saved), ALL, {})
    same(load(saved), edited(busy(), ALL))
    undo(saved, "mine")
    same(load(saved), busy())
    assert validate(saved) == []


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (Edit(remove=("veh_9",)), 'actor "veh_9" is not in .* it has veh_1, veh_2, veh_3. Did you mean'),
        (Edit(remove=("veh_1,veh_2",)), 'actor "veh_1,veh_2" is not in .*; if .* repeat the option: --remove veh_1 --remove veh_2$'),
        (Edit(retime={"veh_1, veh_2": 9}), "repeat the option: --retime veh_1=... --retime veh_2=...$"),
        (Edit(remove=("veh_1",), shift={"veh_1": (1, 0)}), "both removed and changed"),
        (Edit(retime={"veh_3": 1000}), "veh_3 stands still"),
        (Edit(shift={"veh_1": (0.0, 0.0)}), "by zero, which changes nothing"),
        (Edit(retime={"veh_1": 0}), "by zero, which changes nothing"),
    ],
)
def test_an_edit_that_makes_no_sense_changes_nothing(saved, edit, said):
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    with pytest.raises(ValueError, match=said):
        add_change(saved, "mine", load(saved), edit, {})
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before


def test_nothing_is_shifted_by_metres_in_a_scene_that_has_none():
    scene = replace(busy(), meta={**busy().meta, "metric": False})
    with pytest.raises(ValueError, match="the shift of veh_2 is in metres, but street has no metric scale"):
        edited(scene, Edit(shift={"veh_2": (1.0, 0.0)}))
    edited(scene, Edit(remove=("veh_2",)))


def test_editing_what_an_edit_removed_names_that_edit(saved):
    add_change(saved, "mine", load(saved), Edit(remove=("veh_2",)), {"kind": "edit", "remove": ["veh_2"]})
    with pytest.raises(ValueError, match="veh_2 is not in street any more: the edit mine removed it; --undo mine brings it back"):
        add_change(saved, "more", load(saved), Edit(shift={"veh_2": (1.0, 0.0)}), {})


def test_an_edited_scene_moved_elsewhere_keeps_its_edits(saved, tmp_path):
    add_change(saved, "mine", load(saved), ALL, {})
    shutil.move(saved, tmp_path / "elsewhere")
    same(load(tmp_path / "elsewhere"), edited(busy(), ALL))


def test_an_edit_says_what_it_brings_an_actor_into_and_not_what_it_was_in_before():
    scene = busy()
    clear = meeting(Edit(retime={"veh_2": 0}), scene)
    into = meeting(Edit(shift={"veh_3": (-13.0, -5.0)}), scene)
    assert not clear and any(line.startswith("veh_3 ") for line in into)
    assert not meeting(Edit(shift={"veh_3": (-13.0, -5.0)}, remove=("veh_3",)), scene)


def test_another_actor_of_much_the_same_name_is_told_though_one_was_in_the_way_before():
    scene, still = busy(), Trajectory(torch.tensor([START_US]), translation(15.0, 5.0, 0.0)[None])
    beside = Trajectory(torch.tensor([START_US]), translation(15.0, 15.0, 0.0)[None])
    scene = replace(scene, actors=(*scene.actors, Actor(car(), still, "car 1"), Actor(car(), beside, "car 2")))
    told = meeting(Edit(shift={"veh_3": (0.0, 10.0)}), scene)
    assert any(line.startswith("veh_3 runs into car 2") for line in told)
    told = meeting(Edit(shift={"car 2": (0.0, -10.0)}), scene)
    assert {line.split(" (")[0] for line in told if "runs into" in line} == {"car 2 runs into veh_3", "car 2 runs into car 1"}


def test_a_replaced_actor_whose_unseen_side_recorded_cameras_see_is_said():
    seen = {**dict.fromkeys(SECTORS, 0), "front": 30}
    guessed = replace(VAN, meta={"id": "van/0001", "sectors": seen})
    told = meeting(Edit(replace={"veh_2": guessed}), busy())
    assert any("van/0001 is shown from its" in line and "is a guess" in line for line in told)
    assert not any("is a guess" in line for line in meeting(Edit(replace={"veh_2": VAN}), busy()))


def test_putting_in_where_no_files_are_taken_says_so(saved, monkeypatch):
    with monkeypatch.context() as context, pytest.raises(PermissionError, match="cannot write .*edits is not writable; give a folder"):
        context.setattr(os, "access", lambda path, mode: Path(path) != saved / "edits")  # root may write anywhere
        add_edit(saved, "new", [Actor(VAN, Trajectory(torch.tensor([0]), translation(9.0)[None]), "new")], {})
    assert not list((saved / "edits").iterdir())
