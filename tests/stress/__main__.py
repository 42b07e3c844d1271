"""`python -m tests.stress [--device cuda]` prints the table of hazards; exit 1 where one failed."""

import argparse
import sys

from tests.stress.conduct import CONDUCT
from tests.stress.hazards import run, run_conduct, table
from tests.stress.optics import HAZARDS
from tests.stress.properties import PROPERTIES, run_property

parser = argparse.ArgumentParser(prog="python -m tests.stress", description=__doc__)
parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
device = parser.parse_args().device
outcomes = {name: run(name, device) for name in HAZARDS}
outcomes |= {name: run_conduct(check, device) for name, check in CONDUCT.items()}
outcomes |= {name: run_property(name) for name in PROPERTIES}
print(table(outcomes))
for name, outcome in outcomes.items():
    for failure in outcome.failures:
        print(f"{name}: {failure}", file=sys.stderr)
sys.exit(any(o.failures for o in outcomes.values()))
