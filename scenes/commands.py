"""`sidestep info`, `sidestep validate`, `sidestep convert` and `sidestep edit`."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from tyro.conf import Positional, UseAppendAction, arg

from scenes.opening import UsageError, dropped, fresh, open_scene, open_splats
from scenes.options import AnyPath, Axis, Flag, Name, Overwrite, Replacement, Retiming, ScenePath, Shift, Track
from scenes.warnings import warn

if TYPE_CHECKING:
    from scenes.usd.undo import Undone

Value = TypeVar("Value")


@dataclass
class Info:
    """Describe a scene, databank, asset or splat file."""

    path: AnyPath
    """Folder or file."""
    json: Flag = False
    """As JSON."""

    def run(self) -> None:
        from scenes.report import describe, summary

        told = describe(self.path)
        if self.json:
            import json

            print(json.dumps(told, indent=1))
        else:
            print("\n".join(summary(told)))


@dataclass
class Validate:
    """Check a scene, databank, asset or splat file, with USD's own validators too; exit 1 where something is wrong."""

    path: AnyPath
    """Folder or file."""
    drop_invalid: Flag = False
    """Count splats with values that are not finite, and check the rest."""

    def run(self) -> None:
        from scenes.files import Dropping, as_is
        from scenes.report import validate

        dropping = Dropping()
        problems = validate(self.path, dropping if self.drop_invalid else as_is)
        for problem in problems:
            print(problem)
        if dropping.count:
            print(dropped(dropping.count))
        if problems:
            raise ValueError(f"{self.path} has {len(problems)} problem{'s' * (len(problems) > 1)}")
        print(f"{self.path} is valid")


@dataclass
class Convert:
    """Convert splats between PLY, PlayCanvas compressed PLY, USD, GLB, SPZ, .splat and SOG, and say what the new file keeps of them."""

    source: AnyPath
    """Splat file or asset to read."""
    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """File to write; its suffix says the format: .ply, .compressed.ply, .usdc, .usda, .glb, .spz, .splat or .sog."""
    up: Axis = None
    """Up axis of the source: x, -x, y, ...; by default y for .glb and .spz, what a USD file says, else z. Splats trained from photos mostly
    have -y. The target has z up; .glb and .spz have y up."""
    drop_invalid: Flag = False
    """Leave out splats with values that are not finite, and count them, instead of refusing the file."""
    overwrite: Overwrite = False
    """Replace an existing file."""

    def run(self) -> None:
        fresh(self.target, self.overwrite)
        from scenes.asset import Asset
        from scenes.convert import convert, stood_up
        from scenes.formats.axis import axis_warning, said_up
        from scenes.formats.trained import model_of

        thing, warnings = open_splats(self.source, self.drop_invalid, self.up)
        if self.up is not None and not isinstance(thing, Asset):
            thing = stood_up(thing, self.source, self.up)
        said = "z" if isinstance(thing, Asset) else self.up or said_up(self.source)
        turned = _turned(self.source, self.target, said)
        warn([*warnings, *(axis_warning(self.source) if said is None and turned else [])])
        for line in turned:
            print(line)
        print(f"wrote {self.target}: {convert(thing, self.target, self.overwrite, model_of(self.source))}")


def _turned(source: Path, target: Path, up: str | None) -> list[str]:
    """How splats are turned and scaled on their way from a file whose axis `up` is, None where nobody says, to another, as sentences."""
    from scenes.formats import GLB, SPZ, USD, found, named

    after = "y" if named(target) in (GLB, SPZ) else "z"
    metres = 1.0
    if found(source) is USD:
        from scenes.usd.splats import stage_axes

        metres = stage_axes(source)[1]
    taken = f"{source} does not say which of its axes points up, as {target} will; z is taken to, and --up names another, as --up=-y"
    done = [f"turned from {up} up to {after} up"] if up not in (None, after) else []
    done += [f"scaled from units of {metres:g} m to metres"] if metres != 1 else []
    lines = [taken] if up is None and named(target) in (GLB, SPZ, USD) else []
    return [*lines, f"{source} is {' and '.join(done)}"] if done else lines


@dataclass
class Edit:
    """Remove, shift, replace or retime actors of a scene, as a layer that leaves the rest of the scene untouched."""

    scene: ScenePath
    """Scene folder."""
    remove: UseAppendAction[tuple[Track, ...]] = ()
    """Remove an actor or a parked vehicle, as veh_12."""
    shift: UseAppendAction[tuple[Shift, ...]] = ()
    """Move an actor by metres forward and left, in its own frame, as veh_3=0m,1.5m."""
    replace: UseAppendAction[tuple[Replacement, ...]] = ()
    """Replace an actor by an asset, on the same path with its wheels on the ground, as veh_4=car/0003."""
    retime: UseAppendAction[tuple[Retiming, ...]] = ()
    """Delay an actor, or with a minus sign advance it, as veh_5=+0.5s."""
    undo: UseAppendAction[tuple[Track, ...]] = ()
    """Undo an edit by its name, and delete its files; also one that sidestep insert made."""
    name: Name = None
    """Name of the new edit."""
    databank: Path = Path("databank")
    """Folder of the databank: for --replace, and for inserted actors that --shift or --retime brings to other light, or nearer."""

    def run(self) -> None:
        asked = bool(self.remove or self.shift or self.replace or self.retime)
        if not asked and not self.undo:
            raise UsageError("nothing to do: give --remove, --shift, --replace or --retime, as --remove veh_12, or --undo an edit")
        from scenes.alone import alone
        from scenes.usd.undo import undone

        with ExitStack() as stack:
            stack.enter_context(alone(self.scene))
            gone = stack.enter_context(undone(self.scene, self.undo))
            warnings, said = self._changed() if asked else ([], [])
        for line in (*(_without(self.scene, edit) for edit in gone), *said):
            print(line)
        warn(warnings)

    def _changed(self) -> tuple[list[str], list[str]]:
        """Write the edit's layer; what to warn of, and what was done."""
        from scenes import Databank
        from scenes import edit as edits
        from scenes.astray import astray, meeting
        from scenes.match import light_held, other_model
        from scenes.usd.edit import add_change, free_name

        scene, _ = open_scene(self.scene)
        wanted = _once(self.replace, "--replace")
        bank = Databank(self.databank)
        assets = {track: bank.load(asset) for track, asset in wanted.items()}
        edit = edits.Edit(self.remove, _once(self.shift, "--shift"), assets, _once(self.retime, "--retime"))
        own = {a.track: bank.original(a.asset) for a in scene.actors if edit.places(a) and a.track not in assets}
        edit = replace(edit, originals={track: asset for track, asset in own.items() if asset is not None})
        told = {"remove": self.remove, "shift_m": edit.shift, "replace": wanted, "retime_us": edit.retime}
        name = self.name or free_name(self.scene, "edit")
        edits.check_edit(edit, scene)
        others = [line for track, asset in assets.items() for line in other_model(wanted[track], asset, scene)]
        lit = {actor.track: edit.apply(actor, scene).asset for actor in scene.actors if edit.places(actor)}
        others += [line for track, asset in lit.items() for line in light_held(wanted.get(track, track), asset, scene)]
        others += edits.coarse(edit, scene, str(self.databank))
        warnings = [*others, *astray(edit, scene), *meeting(edit, scene), *edits.absences(edit, scene)]
        # last, since finding out what to warn of takes seconds: who stops meanwhile has changed nothing
        add_change(self.scene, name, scene, edit, {"kind": "edit", **{key: value for key, value in told.items() if value}})
        layer = self.scene / "edits" / f"{name}.usda"
        done = f"changed {', '.join(edit.tracks())}; {layer} holds the edit: delete it, or give --undo {name}, to undo it"
        return warnings, [done]


def _without(scene: Path, edit: Undone) -> str:
    """What `edit --undo` says of an edit that it took out of a scene."""
    also = f", and without {', '.join(edit.idle)}, which changed only what {edit.name} had brought" if edit.idle else ""
    still = [f"{by} still goes on from where {edit.name} had put {', '.join(tracks)}, and as what" for by, tracks in edit.held.items()]
    but = f"; but {', and '.join(still)}: undo that too, and give it anew" if still else ""
    return f"{scene} is again as it was without {edit.name}{also}{but}"


def _once(pairs: Iterable[tuple[str, Value]], option: str) -> dict[str, Value]:
    """Pairs as a dict; UsageError where a track is given twice."""
    out: dict[str, Value] = {}
    for track, value in pairs:
        if track in out:
            raise UsageError(f"{option} names {track} twice; give it once")
        out[track] = value
    return out
