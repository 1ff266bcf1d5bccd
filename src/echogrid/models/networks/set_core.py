"""The set network in the compiled core: its weights and a robot's array, as the core takes them."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import _core
from echogrid.models.networks import surroundings
from echogrid.models.networks.set_layers import RING_BENDS, STEP_BENDS, STEPS_M, Weights

BEARINGS, RINGS, RING_M = 64, 51, 0.05
"""The polar table of a scan: bearings round the robot, and rings of this width up to REACH_M and one beyond."""

REACH_M = (RINGS - 1) * RING_M
"""How far from the robot the network speaks."""

UNDER = -2.0
"""Log-odds of the floor under the robot."""

LEAST_RAD = np.deg2rad(0.5)
"""Half of the narrowest beam width that is told apart from narrower ones."""


def network(weights: Weights, around: surroundings.Weights | None) -> _core.SetNetwork:
    """The network with its weights; ``around``: of what reads a cell with its surroundings, if anything does."""
    core = _core.SetNetwork(_in_a_row(weights), weights["b1"].size)
    if around is not None:
        layers = [part for i, _ in enumerate(surroundings.DILATIONS) for part in (around[f"s{i}"], around[f"s{i}b"])]
        parts = [around["si"], *layers, *(around[name] for name in ("so", "cw", "cb", "co", "cs"))]
        units, cell_units = around["sb"].size, around["cb"].size
        core.surround(
            [_flat(part) for part in parts], units, around["so"].shape[1] // surroundings.PACK**2, cell_units
        )
    return core


def begun(around: surroundings.Weights | None, array: Float[ndarray, "told"]) -> Float[ndarray, "units"]:
    """What the robot's sonars add to the first layer of the surroundings."""
    if around is None:
        return np.zeros(0, np.float32)
    return _flat(array @ around["sa"] + around["sb"])


def ends_within(mounts: Float[ndarray, "*n sonars 3"], max_range: Float[ndarray, "sonars"] | float) -> bool:
    """Whether the range of a sonar (m) ends within REACH_M, so that what it tells is to end there."""
    return bool(np.nanmin(max_range - np.hypot(mounts[..., 0], mounts[..., 1])) < REACH_M)


def sonar_array(
    mounts: Float[ndarray, "sonars 3"],
    max_range: Float[ndarray, "sonars"] | float,
    footprint_radius: float,
    beam_width: float,
    ends: bool,
) -> _core.SonarArray:
    """An array of sonars.

    Args:
        mounts: m and rad (nan: no such sonar).
        max_range: of each sonar or of all, m.
        footprint_radius: of the robot, m.
        beam_width: of the sonars, rad.
        ends: whether what a sonar tells ends at its range.
    """
    own = np.broadcast_to(np.float32(max_range), len(mounts))
    half_beam = max(beam_width / 2, LEAST_RAD)
    return _core.SonarArray(
        np.ascontiguousarray(mounts, float), np.ascontiguousarray(own), footprint_radius, half_beam, ends
    )


def _in_a_row(w: Weights) -> Float[ndarray, "n"]:
    """All weights as ``set_weights`` of core/set_network.hpp reads them."""
    names = ("w1", "b1", "a1", "w2", "w2p", "w2t", "b2", "a2")
    steps = _echo_bends(w["wp"]), _echo_bends(w["bp"])
    rings = w["wr"] @ RING_BENDS, w["br"] @ RING_BENDS
    parts = [
        *(w[name] for name in names),
        *steps,
        w["w3"],
        w["b3"],
        *rings,
        *(w[n] for n in ("ws", "wf", "bf", "wz")),
    ]
    return np.concatenate([_flat(part) for part in parts])


def _echo_bends(profile: Float[ndarray, "*n knots"]) -> Float[ndarray, "*n bends"]:
    """The profile of an echo as bends, less what these have at their knots: the core adds bend x max(x, knot)."""
    bends = profile.astype(float) @ STEP_BENDS
    bends[..., 0] -= bends[..., 1:] @ STEPS_M
    return bends


def _flat(values: ndarray) -> Float[ndarray, "n"]:
    return np.ascontiguousarray(values, np.float32).ravel()
