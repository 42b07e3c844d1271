"""The front door: `sidestep COMMAND`. The sub-commands stand in commands/, one dataclass each.

Exit codes: 0 done, 1 bad data (one line says what, where and the fix; SIDESTEP_TRACEBACK=1 shows where it came from), 2 usage,
130 interrupted.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from typing import Annotated, Any, NoReturn, Union

import tyro
from tyro.conf import subcommand

from commands.common import UsageError
from commands.demo import Demo
from commands.files import Info, Validate
from commands.reconstruct import Assets, Recon
from commands.repair import Enhance, Pairs, Train
from commands.shoot import Insert, Render
from scenes.names import unknown

DESCRIPTION = "From a recorded drive to a clip of a path that was never driven, with other things on the street."
COMMANDS = {
    "recon": Recon, "assets": Assets, "insert": Insert, "render": Render, "pairs": Pairs, "train": Train, "enhance": Enhance,
    "info": Info, "validate": Validate, "demo": Demo,
}  # fmt: skip


def parse(words: list[str]) -> Any:
    """The command that the words say; prints help or what is wrong and exits where they say none."""
    if words and words[0] in COMMANDS:
        # tyro builds the one command that is asked for: building all takes most of the time of an error
        return tyro.cli(COMMANDS[words[0]], prog=f"sidestep {words[0]}", args=words[1:])
    if words and not words[0].startswith("-"):
        fail(unknown("command", words[0], "sidestep", COMMANDS), 2)
    choices: Any = Union[tuple(Annotated[c, subcommand(name)] for name, c in COMMANDS.items())]  # noqa: UP007 - made at run time
    return tyro.cli(choices, prog="sidestep", description=DESCRIPTION, args=words)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit."""
    command = parse(list(sys.argv[1:] if arguments is None else arguments))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that half-written files are removed on the way out
    try:
        command.run()
    except UsageError as error:
        fail(error, 2)
    except KeyboardInterrupt as stop:
        fail(stop if str(stop) else "interrupted", 130)
    except BrokenPipeError:
        os._exit(1)  # whoever read our output has gone: there is nobody left to tell
    except (ValueError, OSError) as error:
        if os.environ.get("SIDESTEP_TRACEBACK"):
            raise
        named = isinstance(error, OSError) and error.strerror
        fail(f"{error.filename or 'the disk'}: {error.strerror}" if isinstance(error, OSError) and named else error, 1)


def fail(said: object, code: int) -> NoReturn:
    print("sidestep: " + " ".join(str(said).split()), file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    main()
