"""Speed of each sensor model on the same B21 log, in one run, start-up apart; and of MRPT where it is built.

    python -m benchmarks.models [--record]

With --record the figures also go to docs/paper/speed.json.
"""

import sys
import time

import numpy as np

from benchmarks.mapping import long_log
from benchmarks.mrpt import available, mrpt_map
from echogrid import Log, Robot, build_map
from echogrid.mapping.registry import MODELS, sensor_model
from experiments.common.report import record

SCANS, RUNS, RESOLUTION = 2000, 3, 0.12


def rate(name: str, log: Log, robot: Robot) -> float:
    """Scans a second of one pass over the log, from the first map on: what is before is start-up."""
    begin = time.perf_counter()
    steps = build_map(log, robot, sensor_model(name), RESOLUTION)
    next(steps)
    first = time.perf_counter()
    rest = sum(1 for _ in steps)
    # A model that needs the whole log has one map, and nothing to compile.
    return SCANS * rest / (rest + 1) / (time.perf_counter() - first) if rest else SCANS / (first - begin)


def main() -> None:
    robot, log = Robot.load("b21"), long_log(SCANS)
    print(f"models: {SCANS} scans of {robot.sonars} sonars, cells of {RESOLUTION} m; median of {RUNS} runs")
    rates = {name: float(np.median([rate(name, log, robot) for _ in range(RUNS)])) for name in MODELS}
    if available():
        for name, centred in {"mrpt": False, "mrpt-centred": True}.items():
            times = [mrpt_map(log, robot, RESOLUTION, centred=centred)[1] for _ in range(RUNS)]
            rates[name] = SCANS / float(np.median(times))
    for name, scans in rates.items():
        print(f"  {name}: {scans:.0f} scans/s")
    if "--record" in sys.argv[1:]:
        record("speed", {"scans": SCANS, "sonars": robot.sonars, "scans/s": {k: round(v) for k, v in rates.items()}})


if __name__ == "__main__":
    main()
