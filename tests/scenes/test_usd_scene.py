import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pxr import Gf, Usd, UsdGeom
from randomized import START_US, asset, scene, trajectory

from scenes import Actor, Gaussians, Scene, Sky, Trajectory, add_edit, load, load_dropping, save
from scenes.usd.layers import usd_problems


@pytest.fixture
def saved(tmp_path) -> Path:
    save(scene(), tmp_path / "s1")
    return tmp_path / "s1"


def largest(a, b):
    return float((a - b).abs().max())


def same(a: Scene, b: Scene, sky=True) -> None:
    """Assert that scenes agree: poses to 1e-12, splats as USD keeps them, all else exactly."""
    close = 1e-12 * 1e5  # relative to the 100 km that the background stands away
    assert largest(a.background.world_from_local, b.background.world_from_local) < close
    assert torch.equal(a.background.gaussians.means, b.background.gaussians.means)
    assert torch.equal(a.ego.times_us, b.ego.times_us) and largest(a.ego.world_from_body, b.ego.world_from_body) < 1e-12
    assert [x.track for x in a.actors] == [x.track for x in b.actors]
    for x, y in zip(a.actors, b.actors, strict=True):
        assert torch.equal(x.trajectory.times_us, y.trajectory.times_us)
        assert largest(x.trajectory.world_from_body, y.trajectory.world_from_body) < 1e-12
        assert torch.equal(x.asset.gaussians.means, y.asset.gaussians.means) and torch.equal(x.asset.size, y.asset.size)
        assert (x.asset.label, x.asset.model, x.asset.meta) == (y.asset.label, y.asset.model, y.asset.meta)
    assert list(a.rig) == list(b.rig)
    for name, x in a.rig.items():
        y = b.rig[name]
        assert (x.lens, x.width, x.height) == (y.lens, y.width, y.height)
        assert torch.equal(x.exposure, y.exposure) and torch.equal(x.times_us, y.times_us)
        assert (x.shutter, x.readout_us, x.fitted) == (y.shutter, y.readout_us, y.fitted)
        assert y.gains is None if x.gains is None else torch.equal(x.gains, y.gains)
        assert y.flat_field is None if x.flat_field is None else torch.equal(x.flat_field, y.flat_field)
        assert largest(x.body_from_cam, y.body_from_cam) < 1e-12
    assert (a.model, a.meta) == (b.model, b.meta)
    if a.ground is None:
        assert b.ground is None
    else:
        assert torch.equal(a.ground.heights, b.ground.heights)
        assert (a.ground.origin, a.ground.cell) == (b.ground.origin, b.ground.cell)
    if a.sky is None:
        assert b.sky is None
    else:
        assert largest(a.sky.linear, b.sky.linear) <= float(a.sky.linear.max()) / 256


def test_a_scene_returns(saved):
    same(scene(), load(saved))


def test_how_a_camera_reads_out_and_exposes_returns(tmp_path):
    made, gains = scene((), sky=False, ground=False), torch.tensor([[0.5, 0.6, 0.7], [1.5, 1.4, 1.3]])
    read = {"shutter": "rows", "readout_us": -30_000, "times_us": made.ego.times_us[:2], "gains": gains, "fitted": False}
    read["flat_field"] = 0.5 + torch.rand(9, 16, 3)
    made = replace(made, rig={**made.rig, "left": replace(made.rig["left"], **read)})
    save(made, tmp_path / "s1")
    same(made, load(tmp_path / "s1"))


def test_saving_what_was_loaded_writes_the_same_files(saved, tmp_path):
    save(load(saved), tmp_path / "s2")
    for file in sorted(p.relative_to(saved) for p in saved.rglob("*") if p.is_file()):
        if file.suffix in (".hdr", ".json") or file.name == "ground.usdc":
            assert (saved / file).read_bytes() == (tmp_path / "s2" / file).read_bytes(), file
    same(load(saved), load(tmp_path / "s2"))


def test_a_scene_with_nothing_but_a_body_returns(tmp_path):
    still = Trajectory(torch.tensor([START_US]), torch.eye(4)[None])
    bare = Scene(replace(scene().background, gaussians=Gaussians.empty()), (), None, still, {})
    save(bare, tmp_path / "s1")
    same(bare, load(tmp_path / "s1"))
    assert usd_problems(tmp_path / "s1" / "scene.usda") == []


def test_the_folder_is_laid_out_as_designed(saved):
    assert {p.name for p in saved.iterdir()} == {
        "scene.usda", "recorded.usda", "background.usdc", "actors", "edits", "ground.usdc", "sky_linear.hdr", "metadata.json",
    }  # fmt: skip
    stage = Usd.Stage.Open(str(saved / "scene.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetTimeCodesPerSecond() == 1e6 and stage.GetFramesPerSecond() == 10
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 11 * 100_003)
    assert stage.GetPrimAtPath("/World/Background").HasPayload()
    actors = stage.GetPrimAtPath("/World/Actors").GetChildren()
    assert [a.GetName() for a in actors] == ["veh_12", "_12ab__", "veh_12_2", "Veh_12_3"]
    assert all(a.HasAuthoredReferences() for a in actors)
    assert UsdGeom.Imageable(stage.GetPrimAtPath("/World/Ground")).ComputePurpose() == "guide"


def test_usds_own_validators_find_nothing(saved):
    for file in sorted([*saved.rglob("*.usda"), *saved.rglob("*.usdc")]):
        assert usd_problems(file) == [], file


def test_usd_sees_actors_and_cameras_where_sidestep_does(saved):
    stage, made = Usd.Stage.Open(str(saved / "scene.usda")), scene()
    for i in (0, 3, 11):
        time = int(made.ego.times_us[i])
        cache = UsdGeom.XformCache(time - START_US)
        camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Ego/front_camera")).GetCamera(time - START_US)
        ours = made.camera("front camera", time)
        pixel = torch.tensor([[400.0, 200.0], [1700.0, 900.0]], dtype=torch.float64)
        world = ours.world_from_cam @ torch.cat([ours.lens.unproject(pixel) * 9, torch.ones(2, 1)], 1).T
        for point, (u, v) in zip(world.T.tolist(), pixel.tolist(), strict=True):
            seen = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
            ndc = seen.Transform(Gf.Vec3d(*point[:3]))
            assert ((ndc[0] + 1) / 2 * 1920, (1 - ndc[1]) / 2 * 1080) == pytest.approx((u, v), abs=2e-3)  # apertures are floats
        if made.actors[0].trajectory.covers(time):
            theirs = cache.GetLocalToWorldTransform(stage.GetPrimAtPath("/World/Actors/veh_12"))
            assert list(theirs.ExtractTranslation()) == pytest.approx(made.actors[0].trajectory.at(time)[:3, 3].tolist())


def test_usd_shows_an_actor_only_while_it_exists(saved):
    stage, path = Usd.Stage.Open(str(saved / "scene.usda")), scene().actors[0].trajectory
    prim = UsdGeom.Imageable(stage.GetPrimAtPath("/World/Actors/veh_12"))
    first, last = path.span_us()
    for time in [first - 1, first, last, last + 1, *range(first - 50_000, last + 50_000, 9_001)]:
        assert (prim.ComputeVisibility(time - START_US) == "inherited") == path.covers(time)


def test_the_dome_light_turns_the_sky_as_sidestep_does(saved):
    """In a latlong texture +z is in the centre, +x at a quarter from the left and +y on top (OpenEXR, as UsdLux says)."""
    stage, sky = Usd.Stage.Open(str(saved / "scene.usda")), scene().sky
    world_from_dome = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/World/Lights/Sky"))
    h, w = sky.linear.shape[:2]
    shown = Sky(sky.linear)
    for row, column in ((0, 0), (3, 20), (8, 15), (12, 31)):
        longitude, latitude = math.pi * (1 - (2 * column + 1) / w), math.pi * (0.5 - (row + 0.5) / h)
        x, y, z = math.cos(latitude) * math.sin(longitude), math.sin(latitude), math.cos(latitude) * math.cos(longitude)
        direction = torch.tensor(list(world_from_dome.TransformDir(Gf.Vec3d(x, y, z))))
        alone = Sky(torch.zeros_like(sky.linear))
        alone.linear[row, column] = 1
        assert alone.colour(direction).tolist() == pytest.approx([1, 1, 1], abs=1e-3), (row, column)
    assert torch.isfinite(shown.linear).all()


def test_an_existing_target_is_refused_and_a_foreign_one_never_replaced(saved, tmp_path):
    with pytest.raises(FileExistsError, match="-w"):
        save(scene(), saved)
    save(scene(tracks=("only",)), saved, overwrite=True)
    assert [a.track for a in load(saved).actors] == ["only"] and {p.name for p in (saved / "actors").iterdir()} == {"only.usdc"}
    for foreign in (tmp_path / "holiday", tmp_path / "empty"):
        foreign.mkdir()
    (tmp_path / "holiday" / "metadata.json").write_text("{}")
    for foreign in (tmp_path / "holiday", tmp_path / "empty"):
        with pytest.raises(FileExistsError, match="not a Sidestep scene"):
            save(scene(), foreign, overwrite=True)
    assert (tmp_path / "holiday" / "metadata.json").read_text() == "{}"


@pytest.mark.parametrize("broken", ["save_hdr", "save_asset", "save_ground", "_author_world"])
def test_a_write_that_breaks_off_leaves_the_old_scene(saved, monkeypatch, broken):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    monkeypatch.setattr(f"scenes.usd.scene.{broken}", fail)
    with pytest.raises(OSError, match="No space"):
        save(scene(tracks=("new",)), saved, overwrite=True)
    with pytest.raises(OSError, match="No space"):
        save(scene(), saved.parent / "s2")
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before
    assert [p.name for p in saved.parent.iterdir()] == ["s1"]


FILES = ["background.usdc", "actors/veh_12.usdc", "ground.usdc", "sky_linear.hdr", "metadata.json", "scene.usda", "recorded.usda"]


@pytest.mark.parametrize("lost", FILES)
def test_a_missing_file_is_named(saved, lost, capfd):
    (saved / lost).unlink()
    with pytest.raises((FileNotFoundError, ValueError), match=Path(lost).name):
        load(saved)
    assert capfd.readouterr().err == ""  # USD's own warnings are not shown


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda m: m.update(version=99), "version 99"),
        (lambda m: m.update(format="other"), "not a Sidestep scene"),
        (lambda m: m.pop("origin_us"), "corrupt.*origin_us"),
        (lambda m: m["cameras"]["left"].pop("lens"), "corrupt.*lens"),
        (lambda m: m["cameras"]["left"]["lens"].update(type="fisheye9"), "fisheye9 lens"),
        (lambda m: m["cameras"]["left"].update(prim="gone"), "/World/Ego/gone is not"),
        (lambda m: m["model"].update(projection="magic"), "projection must be one of"),
    ],
)
def test_spoiled_metadata_is_refused(saved, spoil, said):
    file = saved / "metadata.json"
    meta = json.loads(file.read_text())
    spoil(meta)
    file.write_text(json.dumps(meta))
    with pytest.raises(ValueError, match=said):
        load(saved)


def test_cut_metadata_is_refused(saved):
    file = saved / "metadata.json"
    file.write_text(file.read_text()[:100])
    with pytest.raises(ValueError, match="metadata.json is corrupt"):
        load(saved)


def test_nan_in_an_actor_is_refused_by_name_or_dropped(tmp_path, monkeypatch):
    bad = scene()
    bad.actors[1].asset.gaussians.sh[2, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="actor 12ab/ü: splat 2 has nan in sh"):
        save(bad, tmp_path / "s1")
    monkeypatch.setattr(Gaussians, "validate", lambda *_: None)
    save(bad, tmp_path / "s1")
    monkeypatch.undo()
    with pytest.raises(ValueError, match="_12ab__: splat 2 has nan in sh"):
        load(tmp_path / "s1")
    kept, dropped = load_dropping(tmp_path / "s1")
    assert dropped == 1 and len(kept.actors[1].asset.gaussians) == len(bad.actors[1].asset.gaussians) - 1


def test_a_transform_that_scales_is_refused(saved):
    stage = Usd.Stage.Open(str(saved / "scene.usda"))
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Actors/veh_12")).AddScaleOp().Set(Gf.Vec3f(2))
    stage.Save()
    del stage
    with pytest.raises(ValueError, match="/World/Actors/veh_12 has a transform that scales"):
        load(saved)


@pytest.mark.parametrize("spoil", [2.0, -1.0, float("nan")])
def test_a_pose_that_is_not_rigid_is_refused_before_anything_is_written(tmp_path, spoil):
    bad = scene()
    bad.ego.world_from_body[3, 0, :3] *= spoil
    with pytest.raises(ValueError, match="/World/Ego has a transform that scales, shears, mirrors or is not finite"):
        save(bad, tmp_path / "s1")
    assert not list(tmp_path.iterdir())


def test_loading_sees_what_changed_on_disk_while_another_stage_is_open(saved):
    held = Usd.Stage.Open(str(saved / "scene.usda"))
    save(scene(tracks=("new",)), saved, overwrite=True)
    assert [a.track for a in load(saved).actors] == ["new"]
    assert held


def test_a_scene_moved_elsewhere_still_loads(saved, tmp_path):
    shutil.move(saved, tmp_path / "elsewhere")
    same(scene(), load(tmp_path / "elsewhere"))


def inserted(track, seed=0):
    return Actor(asset(seed), trajectory(4, seed), track)


def test_an_edit_adds_actors_after_the_others_and_changes_nothing_else(saved):
    untouched = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file() and p.name != "scene.usda"}
    add_edit(saved, "first", [inserted("car/0003"), inserted("car 0003", 1)], {"kind": "insert", "at": [20.0, -3.5]})
    add_edit(saved, "second", [inserted("bus", 2)], {"kind": "insert"})
    after = load(saved)
    assert [a.track for a in after.actors] == [a.track for a in scene().actors] + ["car/0003", "car 0003", "bus"]
    assert [a.asset.meta.get("edit") for a in after.actors] == [None] * 4 + ["first", "first", "second"]
    assert [a.asset.meta.get("inserted", False) for a in after.actors] == [False] * 4 + [True] * 3
    assert after.meta["edits"] == [{"kind": "insert", "at": [20.0, -3.5], "name": "first"}, {"kind": "insert", "name": "second"}]
    same(replace(after, actors=after.actors[:4], meta=scene().meta), scene())
    assert largest(after.actors[4].trajectory.world_from_body, inserted("x").trajectory.world_from_body) < 1e-12
    assert all(p.read_bytes() == data for p, data in untouched.items())
    for file in (saved / "scene.usda", *saved.glob("edits/*.usda")):
        assert usd_problems(file) == []


def test_deleting_an_edits_file_undoes_it(saved, capfd):
    add_edit(saved, "first", [inserted("bus")], {})
    (saved / "edits" / "first.usda").unlink()
    after = load(saved)
    assert len(after.actors) == 4 and after.meta["edits"] == [{"missing": True, "name": "first"}]
    assert capfd.readouterr().err == ""
    add_edit(saved, "first", [inserted("bus")], {"again": True})
    assert len(load(saved).actors) == 5


def test_saving_an_edited_scene_bakes_its_edits(saved, tmp_path):
    add_edit(saved, "first", [inserted("bus")], {})
    save(load(saved), tmp_path / "s2")
    baked = load(tmp_path / "s2")
    assert "edits" not in baked.meta and baked.actors[4].asset.meta["inserted"] is True


@pytest.mark.parametrize(
    "name, track, error, said",
    [
        ("first", "x", FileExistsError, "already has an edit first"),
        ("../out", "x", ValueError, "cannot name an edit"),
        ("", "x", ValueError, "cannot name an edit"),
        ("new", "veh_12", ValueError, 'already has an actor "veh_12"'),
        ("new", "bus", ValueError, 'already has an actor "bus"'),
    ],
)
def test_an_edit_that_clashes_is_refused(saved, name, track, error, said):
    add_edit(saved, "first", [inserted("bus")], {})
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    with pytest.raises(error, match=said):
        add_edit(saved, name, [inserted(track)], {})
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before


def test_an_edit_that_breaks_off_leaves_the_scene_as_it_was(saved, monkeypatch):
    def fail(*_):
        raise KeyboardInterrupt

    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    monkeypatch.setattr("scenes.usd.edit.add_sublayer", fail)
    with pytest.raises(KeyboardInterrupt):
        add_edit(saved, "first", [inserted("bus")], {})
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before
