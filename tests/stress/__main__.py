"""`python -m tests.stress [--device cuda]` prints the table of hazards; exit 1 where one failed."""

import argparse
import sys

from tests.stress.hazards import HAZARDS, run, table

parser = argparse.ArgumentParser(prog="python -m tests.stress", description=__doc__)
parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
device = parser.parse_args().device
outcomes = {name: run(name, device) for name in HAZARDS}
print(table(outcomes))
for name, outcome in outcomes.items():
    for failure in outcome.failures:
        print(f"{name}: {failure}", file=sys.stderr)
sys.exit(any(o.failures for o in outcomes.values()))
