"""What the C is told: the weights and the robot's array as tables, everything else as numbers."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.microcontroller.array import seen
from echogrid.models.model import CONE_RAD, LOOK_RAD
from echogrid.models.networks import memory, set_core, set_layers, set_network
from echogrid.models.networks.set_core import BEARINGS, REACH_M, RING_M, RINGS, ends_within
from echogrid.models.networks.set_layers import TOKENS, Weights
from echogrid.robot import Robot

NO_SONAR = 255
"""Index of a token that is none."""

POLAR_SCALE = 8191.0
"""Units of the local map for one of log-odds: as many as 16 bits hold for the most that a scan may say."""

SUM_UNITS = 16384.0
"""Units of a fresh cell's sums for one, those of squares for four: the most that a scan may say fills 16 bits."""

NOWHERE = 2**32 - 1
"""Key of no place."""


@dataclass
class Constants:
    """Definitions of C, and how many bytes of flash their tables take."""

    lines: list[str] = field(default_factory=list)
    table_bytes: int = 0

    def number(self, **values: Any) -> None:
        """Numbers by name; integers as integers."""
        for name, value in values.items():
            told = (
                str(int(value)) + "u" * (value > 2**31) if isinstance(value, int | np.integer) else real(float(value))
            )
            self.lines.append(f"#define {name} {f'({told})' if told.startswith('-') else told}")

    def reals(self, name: str, values: Float[ndarray, "..."]) -> None:
        """A table of float, flat; of rows where it has two axes and is named with brackets."""
        values = np.asarray(values, np.float32)
        self.table_bytes += values.nbytes
        if "[" in name:
            told = ",\n".join("{" + ", ".join(map(real, row.tolist())) + "}" for row in values)
        else:
            name, told = f"{name}[{values.size}]", ", ".join(map(real, values.ravel().tolist()))
        self.lines.append(f"static const float {name} = {{\n{told}}};")

    def rows(self, kind: str, name: str, rows: list[str], row_bytes: int) -> None:
        """A table of structures."""
        self.table_bytes += len(rows) * row_bytes
        self.lines.append(f"static const struct {kind} {name} = {{\n" + ",\n".join(rows) + "};")


def real(value: float) -> str:
    """A float of C that reads back as the same number of single precision."""
    told = f"{float(np.float32(value)):.9g}"
    return (told if set(told) & set(".en") else f"{told}.0") + "f"


def constants(weights: Weights, robot: Robot, cell_m: float) -> Constants:
    """All that the C is told of a network and a robot, for cells of a side (m)."""
    told = Constants()
    _layout(told, weights, robot)
    _remembered(told, robot)
    _window(told, robot, cell_m)
    _weights(told, weights)
    _sonars(told, robot)
    _array(told, robot)
    return told


def can_end(robot: Robot) -> bool:
    """Whether what a sonar tells may end within the local map, if only where it looked from elsewhere just before."""
    reach = robot.max_ranges_m - np.hypot(robot.mounts[:, 0], robot.mounts[:, 1])
    return bool(np.min(reach) - memory.RECENT_M < REACH_M)


def _layout(told: Constants, weights: Weights, robot: Robot) -> None:
    beam = max(robot.beam_width_rad / 2, set_core.LEAST_RAD)
    under = int(np.sum((np.arange(RINGS) + 0.5) * RING_M < robot.footprint_radius_m))
    told.number(TOKENS=TOKENS, BEARINGS=BEARINGS, RINGS=RINGS, RING_M=RING_M, REACH_M=REACH_M)
    told.number(STEP_RAD=2 * np.pi / BEARINGS, UNDER_RINGS=under, POLAR_SCALE=POLAR_SCALE)
    told.number(UNDER=round(set_core.UNDER * POLAR_SCALE), NO_SONAR=NO_SONAR)
    told.number(UNITS=weights["b1"].size, FEATURES=set_layers.FEATURES, TRAITS=memory.TRAITS)
    told.number(STEPS=len(set_layers.STEPS_M) - 1, KNOTS=len(set_layers.RINGS_M), FUSE_UNITS=set_layers.FUSE_UNITS)
    told.number(LIMIT=set_layers.LIMIT, LOOKS=set_layers.LOOKS, FAR_M=memory.FAR_M)
    told.number(AT_M=set_layers.AT_M, TIE_RAD=set_layers.TIE_RAD)
    told.number(NEIGHBOUR_RAD=memory.NEIGHBOUR_RAD, SAME_M=memory.SAME_M)
    told.number(BEAM_RAD=beam, LOG_BEAM=np.log(beam / set_layers.BEAM_RAD))
    told.number(LOOK_COS=np.cos(LOOK_RAD), EDGE_COS=np.sin(CONE_RAD), EDGE_SIN=np.cos(CONE_RAD))
    at_rest = ends_within(robot.mounts, robot.max_ranges_m)
    told.number(ENDS=int(can_end(robot)), ENDS_AT_REST=int(at_rest), FOOTPRINT_M=robot.footprint_radius_m)


def _remembered(told: Constants, robot: Robot) -> None:
    told.number(PLACE_M=memory.PLACE_M, TURN_RAD=memory.TURN_RAD, NOWHERE=NOWHERE)
    told.number(FADE=memory.FADE, PRIOR=memory.PRIOR, RECENT_M=memory.RECENT_M, RECENT_RAD=memory.RECENT_RAD)
    told.number(RECENT_MS=round(1000 * memory.RECENT_S), RECENT_SCANS=memory.RECENT_FRAMES)
    pairs = memory.neighbours(robot.mounts)
    told.lines.append("struct neighbours {\n    uint8_t first, second;\n    float near;\n};")
    rows = [f"{{{a}, {b}, {real(float(near))}}}" for a, b, near in zip(*pairs, strict=True)] or ["{0, 0, 0.0f}"]
    told.number(PAIRS=len(rows))
    told.rows("neighbours", "NEIGHBOURS[PAIRS]", rows, 8)


def _window(told: Constants, robot: Robot, cell_m: float) -> None:
    radius = set_network.STOOD_SHARE * robot.footprint_radius_m
    told.number(SUM_UNITS=SUM_UNITS, REACH_CELLS=int(np.ceil(REACH_M / cell_m)))
    told.number(STOOD_M=radius, STOOD_CELLS=int(np.ceil(radius / cell_m)), STOOD_GAP_M=set_network.STOOD_GAP_M)
    told.number(STOOD_STEP_M=set_network.stood_step(radius) if radius > 0 else 1.0)
    told.number(STOOD_LOG_ODDS=set_network.STOOD)


def _weights(told: Constants, weights: Weights) -> None:
    """A row for each unit that a layer answers with."""
    w = {name: np.asarray(value, np.float32) for name, value in weights.items()}
    for name in ("w1", "a1", "w2", "w2p", "w2t", "a2", "wp", "w3", "wr", "wf"):
        told.reals(name.upper(), w[name].T)
    for name in ("b1", "b2", "bp", "b3", "br", "bf"):
        told.reals(name.upper(), w[name])
    told.reals("WZ", w["wz"])
    told.number(WS=w["ws"][0])
    told.reals("STEPS_M", set_layers.STEPS_M)
    told.reals("RINGS_M", set_layers.RINGS_M)


def _sonars(told: Constants, robot: Robot) -> None:
    shortest, longest = robot.bounds
    told.number(SHORTEST=shortest)
    told.reals("LONGEST", np.array(longest))
    told.reals("MAX_RANGE", robot.max_ranges_m)
    told.reals("MOUNTS[ECHOGRID_SONARS][3]", robot.mounts)


def _array(told: Constants, robot: Robot) -> None:
    """The tokens of each bearing."""
    array, ends = seen(robot), can_end(robot)
    struct = "    float axis, ahead, aside;\n" + ("    float after, before;\n" if ends else "")
    told.lines.append(f"struct token {{\n{struct}    uint8_t sonar, first, end;\n}};")
    sonar = np.where(array.sonar < 0, NO_SONAR, array.sonar)
    columns = (array.axis, array.ahead, array.aside, *((array.after, array.before) if ends else ()))
    rows = []
    for bearing in range(BEARINGS):
        tokens = []
        for at in ((bearing, k) for k in range(TOKENS)):
            whole = sonar[at], array.first[at], array.end[at]
            tokens.append("{" + ", ".join([*(real(float(each[at])) for each in columns), *map(str, whole)]) + "}")
        rows.append("{" + ", ".join(tokens) + "}")
    told.rows("token", "ARRAY[BEARINGS][TOKENS]", rows, TOKENS * (24 if ends else 16))
