"""Maps of a drive by every model and by the peers that are built here, and their scores."""

from dataclasses import astuple, fields

import numpy as np

from benchmarks.mrpt import available, mrpt_map
from echogrid import Frame, Grid, Robot, build_map
from echogrid.mapping.registry import DEFAULT, MODELS, sensor_model
from echogrid.metrics import PathScore, Scores, Truth, path_score, score

PEERS = {"mrpt": False, "mrpt-centred": True}
EVERY = [*(name for name in MODELS if name != DEFAULT), *(PEERS if available() else ())]
"""The paper's network, all classical models, and the peers that are built here. The set network has cells of its own:
studies/generalise measures it."""
SHOWN = [f.name for f in fields(Scores)][:8] + [f.name for f in fields(PathScore)][:3]
"""What ``scored`` tells."""


def mapped(name: str, drive: list[Frame], robot: Robot, resolution: float | None) -> Grid:
    """The map of a drive by a model, a weights file or a peer; ``resolution`` in m, None: the model's own."""
    if name in PEERS:
        assert resolution is not None, "a peer has no cells of its own"
        return mrpt_map(drive, robot, resolution, centred=PEERS[name])[0]
    *_, grid = build_map(drive, robot, sensor_model(name), resolution)
    return grid


def scored(grid: Grid, truth: Truth, robot: Robot) -> tuple[float, ...]:
    """The numbers of SHOWN. Collisions are a share of all pairs: a map that shows few ways has few to collide on."""
    way = path_score(grid, truth, robot.footprint_radius_m)
    collides = 0.0 if np.isnan(way.collides) and way.pairs else way.collides * (1 - way.lost)
    return *astuple(score(grid, truth))[:8], collides, way.blocked, way.lost
