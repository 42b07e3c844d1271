"""What a user should know though the work goes on."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def warn(lines: Sequence[str]) -> None:
    for line in lines:
        print(f"sidestep: warning: {line}", file=sys.stderr)
