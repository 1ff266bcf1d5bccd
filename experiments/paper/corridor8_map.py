"""The recorded corridor, mapped by every model: measures and pictures.

    python -m experiments.paper.corridor8_map [FOLDER [MODEL ...]]

FOLDER holds the recording, of which common/corridor8.py says what is known. MODEL is a name or a weights file;
without one all models are mapped, and the pictures and docs/paper/corridor8.json are written.
"""

import argparse
from pathlib import Path

import numpy as np

from echogrid import Log, Robot
from echogrid.models.networks.local_map import LOCAL_CELL_M
from experiments.common.corridor8 import FOLDER, ROBOT, frames, mark, measure
from experiments.common.maps import EVERY, mapped
from experiments.common.report import Panel, page, record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("models", nargs="*", default=EVERY)
    args = parser.parse_args()
    if not args.folder.is_dir():
        print(f"corridor8: found no folder {args.folder}, so docs/paper/corridor8.* stay as they are")
        return
    robot = Robot.load(ROBOT)
    log = Log.of(frames(args.folder, robot), str(args.folder))
    drive = np.array([frame.pose[:2] for frame in log])
    maps = {name: mapped(name, list(log), robot, LOCAL_CELL_M) for name in args.models}
    measured = {name: measure(grid) for name, grid in maps.items()}
    print("| model | " + " | ".join(next(iter(measured.values()))) + " |")
    for name, shares in measured.items():
        print(f"| {name} | " + " | ".join(f"{v:.1%}" for v in shares.values()) + " |")
    if args.models == EVERY:
        record("corridor8", {name: {k: round(v, 4) for k, v in shares.items()} for name, shares in measured.items()})
        title = "A recorded corridor, eight sonars; what is known of it: two walls along x = 1 .. 9 m"
        panels: list[Panel] = [(name, grid, drive, None) for name, grid in maps.items()]
        page([panel for panel in panels if panel[0] in ("network", "nav2")], 2, 5.6, 0.69, title, "corridor8", mark)
        page(panels, 4, 3.2, 0.69, title, "models_corridor8", mark)


if __name__ == "__main__":
    main()
