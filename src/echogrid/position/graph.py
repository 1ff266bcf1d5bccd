"""A graph of poses in the plane, whose odometry has a systematic error that is estimated with them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from echogrid.geometry import wrap


class Edges(NamedTuple):
    """What is known of poses as seen from others."""

    first: Int[ndarray, "edges"]
    """Node from which the second is seen."""
    second: Int[ndarray, "edges"]
    measured: Float[ndarray, "edges 3"]
    """Pose of the second node in the frame of the first, m, m, rad."""
    information: Float[ndarray, "edges 3 3"]
    """Inverse of its covariance, in the frame of the measured pose."""
    width: Float[ndarray, "edges"]
    """Of a robust kernel, in standard deviations: what is farther off counts less (inf: all count in full)."""
    by: Float[ndarray, "edges 3 parameters"] | None = None
    """How the measured pose changes with the parameters; None: it does not."""
    unit: Int[ndarray, "edges"] | None = None
    """Parameter that with 1 is the unit, m, in which lengths were measured, errors and all; -1, None: 1 m. Without it
    all poses draw together: that makes errors less, which are given in m, the more the more edges there are."""


def joined(edges: Sequence[Edges]) -> Edges:
    """All edges of several sets."""
    parameters = max((each.by.shape[2] for each in edges if each.by is not None), default=0)
    by = [np.zeros((len(each.first), 3, parameters)) if each.by is None else each.by for each in edges]
    first, second, measured, information, width = (np.concatenate([each[k] for each in edges]) for k in range(5))
    unit = np.concatenate([np.full(len(each.first), -1) if each.unit is None else each.unit for each in edges])
    return Edges(first, second, measured, information, width, np.concatenate(by), unit)


class Residuals(NamedTuple):
    """How far poses are off, and how that changes with them."""

    off: Float[ndarray, "edges 3"]
    """In the frame of the measured pose, m, m, rad."""
    by_first: Float[ndarray, "edges 3 3"]
    by_second: Float[ndarray, "edges 3 3"]
    by_measured: Float[ndarray, "edges 3 3"]
    """But for the turning of a residual, which is small."""


def residuals(
    poses: Float[ndarray, "nodes 3"], edges: Edges, measured: Float[ndarray, "edges 3"] | None = None
) -> Residuals:
    """How far poses (m, m, rad) are from what edges say, or from other measured poses in their place."""
    measured = edges.measured if measured is None else measured
    first, second = poses[edges.first], poses[edges.second]
    to_first, to_measured = _turned_back(first[:, 2]), _turned_back(measured[:, 2])
    way = second[:, :2] - first[:, :2]
    seen = np.einsum("nij,nj->ni", to_first, way)
    off = np.empty((len(first), 3))
    off[:, :2] = np.einsum("nij,nj->ni", to_measured, seen - measured[:, :2])
    off[:, 2] = wrap(second[:, 2] - first[:, 2] - measured[:, 2])
    by_first, by_second, by_measured = (np.zeros((len(first), 3, 3)) for _ in range(3))
    by_second[:, :2, :2] = to_measured @ to_first
    by_first[:, :2, :2] = -by_second[:, :2, :2]
    turn = np.stack([seen[:, 1], -seen[:, 0]], axis=-1)
    by_first[:, :2, 2] = np.einsum("nij,nj->ni", to_measured, turn)
    by_measured[:, :2, :2] = -to_measured
    by_first[:, 2, 2], by_second[:, 2, 2], by_measured[:, 2, 2] = -1, 1, -1
    return Residuals(off, by_first, by_second, by_measured)


def _times(found: Residuals, scale: Float[ndarray, "edges"]) -> Residuals:
    """Residuals whose lengths are so many times as long."""
    by_row = np.stack([scale, scale, np.ones(len(scale))], axis=-1)
    return Residuals(found.off * by_row, *(by * by_row[..., None] for by in found[1:]))


def _turned_back(angle: Float[ndarray, "n"]) -> Float[ndarray, "n 2 2"]:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.moveaxis(np.array([[cos, sin], [-sin, cos]]), -1, 0)


def chi2(off: Float[ndarray, "edges 3"], information: Float[ndarray, "edges 3 3"]) -> Float[ndarray, "edges"]:
    """Squares of how far edges are off (m, m, rad), in standard deviations."""
    return np.einsum("ni,nij,nj->n", off, information, off)


def counted(chi2: Float[ndarray, "edges"], width: Float[ndarray, "edges"]) -> Float[ndarray, "edges"]:
    """What edges count, by the squares of how far they are off (dynamic covariance scaling, Agarwal et al. 2013)."""
    with np.errstate(invalid="ignore"):
        scale = np.minimum(1.0, 2 * width**2 / (width**2 + chi2))
    return np.where(np.isinf(width), 1.0, scale**2)


def _cost(chi2: Float[ndarray, "edges"], width: Float[ndarray, "edges"]) -> float:
    """The sum whose derivative by ``chi2`` is ``counted``."""
    with np.errstate(invalid="ignore"):
        far = 3 * width**2 - 4 * width**4 / (chi2 + width**2)
    return float(np.sum(np.where(chi2 <= width**2, chi2, far)))


@dataclass(frozen=True)
class Solution:
    """The poses that agree best with all edges."""

    poses: Float[ndarray, "nodes 3"]
    parameters: Float[ndarray, "parameters"]
    chi2: Float[ndarray, "edges"]
    """Squares of how far the edges are off, in standard deviations."""
    _factor: SuperLU = field(repr=False)

    def covariance(self, nodes: Sequence[int]) -> Float[ndarray, "n n 3 3"]:
        """Covariances between the poses of some nodes."""
        n = len(nodes)
        at = (3 * np.asarray(nodes)[:, None] + np.arange(3)).ravel()
        columns = np.zeros((self._factor.shape[0], 3 * n))
        columns[at, np.arange(3 * n)] = 1
        return self._factor.solve(columns)[at].reshape(n, 3, n, 3).swapaxes(1, 2)


_HELD = 1e9
"""Information that keeps the first node where it is."""


def solve(
    poses: Float[ndarray, "nodes 3"],
    edges: Edges,
    parameters: Float[ndarray, "parameters"],
    spread: Float[ndarray, "parameters"],
    rounds: int = 20,
    tolerance: float = 1e-5,
) -> Solution:
    """Find the poses and parameters that agree best with all edges (Levenberg-Marquardt); node 0 keeps its pose.

    Args:
        poses: to begin with, m, m, rad.
        edges: what is known; what they measured holds for the parameters as they are given.
        parameters: to begin with.
        spread: standard deviations of the parameters, which are 0 in the mean.
        rounds: at most.
        tolerance: no pose and no parameter changes by more, m or rad, when it is done.
    """
    system = _System(len(poses), edges, parameters, spread)
    damping = 1e-6
    point = system.at(poses, parameters)
    for _ in range(rounds):
        matrix, gradient = system.equations(point)
        while True:
            step = -system.factor(matrix, damping).solve(gradient)
            then = system.at(point.poses + step[: poses.size].reshape(-1, 3), point.parameters + step[poses.size :])
            if then.cost <= point.cost + 1e-9 or damping > 1e3:
                break
            damping = max(damping * 10, 1e-4)
        damping = max(damping / 10, 1e-9)
        point = then
        if np.max(np.abs(step)) < tolerance:
            break
    factor = system.factor(system.equations(point)[0], 0.0)
    found = point.poses.copy()
    found[:, 2] = wrap(found[:, 2])
    return Solution(found, point.parameters, point.chi2, factor)


class _Point(NamedTuple):
    """Poses and parameters, and how far they are off."""

    poses: Float[ndarray, "nodes 3"]
    parameters: Float[ndarray, "parameters"]
    residuals: Residuals
    chi2: Float[ndarray, "edges"]
    cost: float


class _System:
    """The normal equations of a graph."""

    def __init__(self, nodes: int, edges: Edges, parameters: ndarray, spread: ndarray):
        self._edges, self._given, self._spread = edges, parameters, spread
        self._size, count = 3 * nodes + len(parameters), len(edges.first)
        self._by = np.zeros((count, 3, len(parameters))) if edges.by is None else edges.by
        unit = np.full(count, -1) if edges.unit is None else edges.unit
        self._in_unit = unit[:, None] == np.arange(len(parameters))
        three = np.arange(3)
        own = np.broadcast_to(3 * nodes + np.arange(len(parameters)), (count, len(parameters)))
        self._at = np.concatenate([3 * edges.first[:, None] + three, 3 * edges.second[:, None] + three, own], axis=1)
        wide = self._at.shape[1]
        self._rows, self._cols = np.repeat(self._at, wide, axis=1).ravel(), np.tile(self._at, (1, wide)).ravel()
        self._known = np.zeros(self._size)
        self._known[:3] = _HELD
        self._known[3 * nodes :] = 1 / spread**2

    def at(self, poses: Float[ndarray, "nodes 3"], parameters: Float[ndarray, "parameters"]) -> _Point:
        measured = self._edges.measured + self._by @ (parameters - self._given)
        found = _times(residuals(poses, self._edges, measured), 1 / (1 + self._in_unit @ parameters))
        squares = chi2(found.off, self._edges.information)
        cost = _cost(squares, self._edges.width) + float(np.sum((parameters / self._spread) ** 2))
        return _Point(poses, parameters, found, squares, cost)

    def equations(self, point: _Point) -> tuple[csc_matrix, Float[ndarray, "size"]]:
        """Half the second derivatives of the cost (of Gauss and Newton), and half the first."""
        off, by_first, by_second, by_measured = point.residuals
        information = self._edges.information * counted(point.chi2, self._edges.width)[:, None, None]
        by_parameters = by_measured @ self._by
        by_parameters[:, :2] -= off[:, :2, None] * (self._in_unit / (1 + point.parameters))[:, None]
        by = np.concatenate([by_first, by_second, by_parameters], axis=2)
        weighted = information @ by
        blocks = np.einsum("nij,nik->njk", by, weighted)
        gradient = np.bincount(self._at.ravel(), np.einsum("nij,ni->nj", weighted, off).ravel(), self._size)
        gradient[self._size - len(self._spread) :] += point.parameters / self._spread**2
        return csc_matrix((blocks.ravel(), (self._rows, self._cols)), shape=(self._size, self._size)), gradient

    def factor(self, matrix: csc_matrix, damping: float) -> SuperLU:
        diagonal = matrix.diagonal() * damping + self._known + 1e-9
        at = np.arange(self._size)
        whole = matrix + csc_matrix((diagonal, (at, at)), shape=matrix.shape)
        return splu(whole, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
