"""Edits are undone, alone and with those that cannot stand without them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from edited_street import ALL, VAN, busy, parking, put_in, same, shown
from pxr import Usd, UsdVol
from street import car

from scenes import Actor, Trajectory, load, save, validate
from scenes.edit import Edit, edited
from scenes.poses import translation
from scenes.usd.edit import add_change, add_edit
from scenes.usd.undo import undo, undone


@pytest.fixture
def saved(tmp_path):
    save(busy(), tmp_path / "s1")
    return tmp_path / "s1"


def test_the_last_of_two_edits_counts_and_both_can_be_undone_alone(saved):
    add_change(saved, "first", load(saved), Edit(shift={"veh_2": (0.0, 1.0)}), {})
    add_change(saved, "second", load(saved), Edit(shift={"veh_2": (0.0, 1.0)}), {})
    place = lambda: float(load(saved).actors[1].trajectory.world_from_body[0, 1, 3])  # noqa: E731
    assert place() == pytest.approx(-1.0)
    undo(saved, "second")
    assert place() == pytest.approx(-2.0)
    undo(saved, "first")
    assert place() == pytest.approx(-3.0)


def test_undoing_says_which_later_edits_go_on_from_where_it_put_an_actor(saved):
    add_change(saved, "shift", load(saved), Edit(shift={"veh_2": (0.0, 1.0), "veh_3": (1.0, 0.0)}), {})
    add_change(saved, "retime", load(saved), Edit(retime={"veh_2": 100_000}), {})
    add_change(saved, "gone", load(saved), Edit(remove=("veh_3",)), {})
    with pytest.raises(KeyError), undone(saved, ["retime"]) as (edit,):
        assert edit.held == {}, "what it went on from does not go on from it"
        raise KeyError
    with undone(saved, ["shift"]) as (edit,):
        assert edit.held == {"retime": ["veh_2"]}
    assert float(load(saved).actors[1].trajectory.world_from_body[0, 1, 3]) == pytest.approx(-2.0)
    with undone(saved, ["gone", "retime"]) as edits:
        assert [e.held for e in edits] == [{}, {}]
    same(load(saved), busy())


def test_an_edit_that_goes_with_a_later_one_leaves_nothing_of_it(saved):
    add_change(saved, "shift", load(saved), Edit(shift={"veh_2": (0.0, 1.0)}), {})
    add_change(saved, "retime", load(saved), Edit(retime={"veh_2": 100_000}), {})
    with undone(saved, ["shift", "retime"]) as edits:
        assert [e.held for e in edits] == [{}, {}]
    same(load(saved), busy())


def test_an_edit_may_be_named_that_goes_with_another(saved):
    put_in(saved)
    add_change(saved, "aside", load(saved), Edit(shift={"new": (1.0, 0.0)}), {})
    with undone(saved, ["new", "aside"]) as edits:
        assert [(e.name, e.idle) for e in edits] == [("new", ("aside",))]
    same(load(saved), busy())


@pytest.mark.parametrize("order", [["new", "both"], ["both", "new"]])
def test_an_edit_of_an_insertion_and_of_more_is_undone_with_it_whichever_is_named_first(saved, order):
    put_in(saved)
    add_change(saved, "both", load(saved), Edit(shift={"new": (1.0, 0.0), "veh_2": (0.0, 1.0)}), {})
    with pytest.raises(ValueError, match="undo both: --undo both --undo new"):
        undo(saved, "new")
    with undone(saved, order) as edits:
        assert [(e.name, e.idle, e.held) for e in edits] == [(name, (), {}) for name in order]
    same(load(saved), busy())


def test_what_was_undone_is_back_where_what_comes_after_fails(saved):
    put_in(saved)
    add_change(saved, "aside", load(saved), Edit(shift={"new": (1.0, 0.0)}), {})
    add_change(saved, "mine", load(saved), ALL, {})
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    with pytest.raises(ValueError, match='"veh_9" is not in'), undone(saved, ["new", "mine"]):
        add_change(saved, "mine", load(saved), Edit(remove=("veh_9",)), {})
    with pytest.raises(ValueError, match='edit "typo" is not in'), undone(saved, ["mine", "typo"]):
        pass
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before
    assert {p.name for p in saved.iterdir()} == {p.relative_to(saved).parts[0] for p in before}


def test_what_a_killed_undoing_put_aside_is_in_nobodys_way_and_goes_with_the_next_edit(saved):
    add_change(saved, "mine", load(saved), ALL, {})
    kill = "import os, sys; from scenes.usd.undo import undone\nwith undone(sys.argv[1], ['mine']): os.kill(os.getpid(), 9)"
    for next_edit in (lambda: put_in(saved), lambda: undo(saved, "new")):
        subprocess.run([sys.executable, "-c", kill, str(saved)], check=False)
        (aside,) = saved.glob(".undone.*")
        assert (aside / "mine.usda").exists() and validate(saved) == []
        next_edit()
        assert not aside.exists()
        add_change(saved, "mine", load(saved), ALL, {})


def test_undoing_in_a_folder_that_takes_no_files_says_so_and_leaves_all(saved, monkeypatch):
    put_in(saved)
    for folder in (saved, saved / "edits"):
        with monkeypatch.context() as context, pytest.raises(PermissionError, match=f"{folder} is not writable"):
            context.setattr(os, "access", lambda path, mode, folder=folder: Path(path) != folder)  # root may write anywhere
            undo(saved, "new")
    assert load(saved).actors[-1].track == "new"


def test_an_edit_of_what_was_shifted_hides_what_the_recording_says(saved):
    """And nothing of where the first edit put it, so that either can be undone alone."""
    ghost_alone = shown(edited(busy(), Edit(remove=("veh_2",))))
    onto_more = Edit(shift={"veh_2": (0.0, 5.5)}), Edit(remove=("veh_2",))  # veh_1 comes along there
    for name, edit in zip(("shift", "gone"), onto_more, strict=True):
        add_change(saved, name, load(saved), edit, {})
    assert torch.equal(shown(load(saved)), ghost_alone)
    undo(saved, "shift")
    assert torch.equal(shown(load(saved)), ghost_alone)
    undo(saved, "gone")
    assert shown(load(saved)).all()


@pytest.mark.parametrize("undone", [undo, lambda scene, name: (scene / "edits" / f"{name}.usda").unlink()], ids=["undo", "by hand"])
@pytest.mark.parametrize("half", [False, True])
def test_undoing_an_edit_shows_again_what_it_alone_hid(tmp_path, undone, half):
    scene, edits = parking(), {"first": Edit(("veh_7",), shift={"veh_2": (0.0, 1.0)}), "second": Edit(remove=("veh_2",))}
    alone = {name: shown(edited(scene, edit)) for name, edit in edits.items()}
    save(scene, tmp_path / "s1", half=half)
    for name, edit in edits.items():
        add_change(tmp_path / "s1", name, load(tmp_path / "s1"), edit, {})
    assert torch.equal(shown(load(tmp_path / "s1")), alone["first"] & alone["second"])
    undone(tmp_path / "s1", "first")
    assert torch.equal(shown(load(tmp_path / "s1")), alone["second"]) and not torch.equal(*alone.values())
    stage = Usd.Stage.Open(str(tmp_path / "s1" / "scene.usda"))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Background/Gaussians"))
    seen = (splats.GetOpacitieshAttr() if half else splats.GetOpacitiesAttr()).Get()
    assert [v > 0 for v in seen] == alone["second"].tolist()


@pytest.mark.parametrize(
    ("file", "left", "said"),
    [
        ("mine.usda", 300, "mine.usda is damaged"),
        ("mine.usda", 0, "mine.usda is damaged"),
        ("mine.usda", b"over", "mine.usda is damaged"),
        ("mine/hidden.usda", b"over", "mine/hidden.usda is damaged"),
        ("mine/hidden.usda", 300, "mine/hidden.usda is damaged"),
        ("mine/hidden.usda", None, "mine/hidden.usda is missing"),
        ("mine/veh_3.usdc", None, "mine/veh_3.usdc is missing"),
        ("mine/veh_3.usdc", 300, "mine/veh_3.usdc is damaged"),
    ],
)
def test_an_edit_that_is_not_whole_is_refused_until_it_is_undone(saved, file, left, said):
    add_change(saved, "mine", load(saved), ALL, {})
    if left is None:
        (saved / "edits" / file).unlink()
    else:  # bytes: cut right before the first of them, where what is left is a whole layer that says nothing
        path = saved / "edits" / file
        os.truncate(path, left if isinstance(left, int) else path.read_bytes().index(b"\n" + left) + 1)
    with pytest.raises(ValueError, match=f"{said}.*restore it, or undo the edit: sidestep edit {saved} --undo mine"):
        load(saved)
    assert any(said in problem for problem in validate(saved)) and not any("deleted" in problem for problem in validate(saved))
    undo(saved, "mine")
    same(load(saved), busy())


IDLE = {"gone": Edit(remove=("new",)), "other": Edit(replace={"new": car()}), "aside": Edit(shift={"new": (1.0, 0.0)})}


@pytest.mark.parametrize("by_hand", [False, True])
@pytest.mark.parametrize("name", IDLE)
def test_undoing_what_brought_an_actor_takes_along_what_changed_only_that(saved, name, by_hand):
    put_in(saved)
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file() and "new" not in p.name}
    add_change(saved, name, load(saved), IDLE[name], {})
    if by_hand:
        (saved / "edits" / "new.usda").unlink()
        same(load(saved), busy())
    assert undo(saved, "new") == [name]
    assert {p for p in saved.rglob("*") if p.is_file()} == {p for p in before if "new" not in p.parts}
    same(load(saved), busy())
    put_in(saved)
    assert [a.track for a in load(saved).actors][-1] == "new"


def test_an_edit_of_what_was_brought_and_of_more_is_undone_first(saved):
    put_in(saved)
    add_change(saved, "both", load(saved), Edit(remove=("new", "veh_1")), {})
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    with pytest.raises(ValueError, match="the edit both changes more than new, which new brought; undo both: --undo both --undo new"):
        undo(saved, "new")
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before
    assert undo(saved, "both") == [] and undo(saved, "new") == []
    same(load(saved), busy())


@pytest.mark.parametrize("name", IDLE)
def test_an_edit_of_an_actor_that_went_by_hand_does_not_meet_the_next_one_of_its_name(saved, name):
    put_in(saved)
    add_change(saved, name, load(saved), IDLE[name], {})
    (saved / "edits" / "new.usda").unlink()
    put_in(saved)
    after = load(saved)
    assert [a.track for a in after.actors] == ["veh_1", "veh_2", "veh_3", "new"] and after.actors[-1].asset.label == "van"
    assert after.actors[-1].trajectory.world_from_body[0, 0, 3] == 9.0


def test_the_track_of_a_removed_actor_stays_its_own(saved):
    put_in(saved)
    add_change(saved, "gone", load(saved), Edit(remove=("new",)), {})
    with pytest.raises(ValueError, match='already has an actor "new"'):
        add_edit(saved, "again", [Actor(VAN, Trajectory(torch.tensor([0]), translation(9.0)[None]), "new")], {})
