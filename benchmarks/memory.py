"""Peak memory of `echogrid map` for logs of 1,000, 10,000 and 100,000 scans over the same room.

Each run is a process of its own; the peak is what the operating system counted (ru_maxrss).
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.mapping import long_log
from echogrid.logs.csv_log import write_csv

RUN = """
import resource, sys
from echogrid.cli import main
main(sys.argv[1:])
print("PEAK", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for scans in (1_000, 10_000, 100_000):
            path = Path(folder) / f"{scans}.csv"
            write_csv(path, long_log(scans), 24)
            args = ["map", str(path), "--robot", "b21", "--out", str(Path(folder) / "map")]
            run = subprocess.run([sys.executable, "-c", RUN, *args], capture_output=True, text=True, check=True)
            peak = int(run.stdout.split("PEAK")[1]) / 1024
            print(f"memory: {scans:7} scans ({path.stat().st_size / 1e6:5.1f} MB of log): peak {peak:.0f} MB")
            path.unlink()


if __name__ == "__main__":
    main()
