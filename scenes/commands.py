"""`sidestep info` and `sidestep validate`."""

from __future__ import annotations

from dataclasses import dataclass

from scenes.opening import dropped
from scenes.options import AnyPath, Flag


@dataclass
class Info:
    """Say what a scene, databank, PLY or USD file holds."""

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
    """Check a scene, databank, PLY or USD file, with USD's own validators too; exit 1 where something is wrong."""

    path: AnyPath
    """Folder or file."""
    drop_invalid: Flag = False
    """Count splats with values that are not finite, and check what is left without them."""

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
