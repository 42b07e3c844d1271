"""What torch's idle workers do, said before torch is loaded: OpenMP reads it once, then. Every package imports this first.

They would spin for milliseconds on the cores that Warp's threads, or other programs, need, so that a parallel operation waits for a worker
that waits for its core; and if they never spun, waking them would cost as much as many an operation. So they spin for some 60
microseconds, until the next one.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "30000")
