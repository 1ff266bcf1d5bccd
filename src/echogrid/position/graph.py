"""A graph of poses in the plane, whose odometry has a systematic error that is estimated with them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from echogrid.geometry import compose, inverse, wrap


class Edges(NamedTuple):
    """What is known of poses as seen from others."""

    first: Int[ndarray, "edges"]
    second: Int[ndarray, "edges"]
    measured: Float[ndarray, "edges 3"]
    """Pose of the second node as seen from the first, m, m, rad."""
    information: Float[ndarray, "edges 3 3"]
    """Inverse of its covariance, in the frame of the measured pose."""
    width: Float[ndarray, "edges"]
    """Of a robust kernel, in standard deviations: what is farther off counts less (inf: none)."""
    by: Float[ndarray, "edges 3 parameters"] | None = None
    """How the measured pose changes with the parameters."""


def joined(edges: list[Edges]) -> Edges:
    most = max((e.by.shape[2] for e in edges if e.by is not None), default=0)
    by = [np.zeros((len(e.first), 3, most)) if e.by is None else e.by for e in edges]
    return Edges(*(np.concatenate([np.asarray(e[k]) for e in edges]) for k in range(5)), np.concatenate(by))


def errors(poses: Float[ndarray, "nodes 3"], e: Edges, measured: Float[ndarray, "edges 3"]):
    """Residuals, and their derivatives by both poses."""
    i, j = poses[e.first], poses[e.second]
    c, s = np.cos(i[:, 2]), np.sin(i[:, 2])
    d = j[:, :2] - i[:, :2]
    seen = np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]], axis=-1)
    cz, sz = np.cos(measured[:, 2]), np.sin(measured[:, 2])
    off = seen - measured[:, :2]
    residual = np.stack(
        [
            cz * off[:, 0] + sz * off[:, 1],
            -sz * off[:, 0] + cz * off[:, 1],
            wrap(j[:, 2] - i[:, 2] - measured[:, 2]),
        ],
        axis=-1,
    )
    n = len(residual)
    Rz = np.zeros((n, 2, 2))
    Rz[:, 0, 0], Rz[:, 0, 1], Rz[:, 1, 0], Rz[:, 1, 1] = cz, sz, -sz, cz
    Ri = np.zeros((n, 2, 2))
    Ri[:, 0, 0], Ri[:, 0, 1], Ri[:, 1, 0], Ri[:, 1, 1] = c, s, -s, c
    RR = Rz @ Ri
    A = np.zeros((n, 3, 3))
    B = np.zeros((n, 3, 3))
    A[:, :2, :2] = -RR
    B[:, :2, :2] = RR
    turn = np.stack([-s * d[:, 0] + c * d[:, 1], -c * d[:, 0] - s * d[:, 1]], axis=-1)
    A[:, :2, 2] = np.einsum("nij,nj->ni", Rz, turn)
    A[:, 2, 2], B[:, 2, 2] = -1, 1
    # by the measured pose's translation (its rotation only turns a small residual)
    M = np.zeros((n, 3, 3))
    M[:, :2, :2] = -Rz
    M[:, 2, 2] = -1
    return residual, A, B, M


def weights(chi2: Float[ndarray, "edges"], width: Float[ndarray, "edges"]) -> Float[ndarray, "edges"]:
    """What edges count (dynamic covariance scaling, Agarwal 2013)."""
    with np.errstate(invalid="ignore"):
        s = np.minimum(1.0, 2 * width**2 / (width**2 + chi2))
    return np.where(np.isinf(width), 1.0, s**2)


@dataclass
class Solution:
    poses: Float[ndarray, "nodes 3"]
    parameters: Float[ndarray, "parameters"]
    chi2: Float[ndarray, "edges"]
    weight: Float[ndarray, "edges"]
    factor: object = field(repr=False, default=None)

    def covariance(self, nodes) -> Float[ndarray, "n n 3 3"]:
        """Covariance of the poses of some nodes, blocks."""
        size = self.factor.shape[0]
        n = len(nodes)
        columns = np.zeros((size, 3 * n))
        at = (3 * np.asarray(nodes)[:, None] + np.arange(3)).ravel()
        columns[at, np.arange(3 * n)] = 1
        return self.factor.solve(columns)[at].reshape(n, 3, n, 3).swapaxes(1, 2)


def solve(
    poses: Float[ndarray, "nodes 3"],
    edges: Edges,
    parameters: Float[ndarray, "parameters"],
    spread: Float[ndarray, "parameters"],
    rounds: int = 20,
    tolerance: float = 1e-5,
    anchor: int = 0,
) -> Solution:
    """Gauss-Newton with a robust kernel; the anchor keeps its pose."""
    poses, start = poses.copy(), parameters.copy()
    given = start.copy()
    parameters = parameters.copy()
    n, k = len(poses), len(parameters)
    size = 3 * n + k
    m = len(edges.first)
    by = edges.by if edges.by is not None else np.zeros((m, 3, k))
    at_i = 3 * edges.first[:, None] + np.arange(3)
    at_j = 3 * edges.second[:, None] + np.arange(3)
    at_p = np.broadcast_to(3 * n + np.arange(k), (m, k))
    at = np.concatenate([at_i, at_j, at_p], axis=1)  # [m, 6 + k]
    rows = np.repeat(at, at.shape[1], axis=1).ravel()
    cols = np.tile(at, (1, at.shape[1])).ravel()

    def look(poses, parameters):
        measured = edges.measured + by @ (parameters - given)
        r, A, B, M = errors(poses, edges, measured)
        chi2 = np.einsum("ni,nij,nj->n", r, edges.information, r)
        return r, A, B, M, chi2

    damping = 1e-6
    r, A, B, M, chi2 = look(poses, parameters)

    def cost(chi2, parameters):
        w = edges.width
        with np.errstate(invalid="ignore"):
            robust = np.where(np.isinf(w) | (chi2 <= w**2), chi2, 3 * w**2 - 4 * w**4 / (chi2 + w**2) + 0)
        robust = np.where(np.isinf(w), chi2, robust)
        return robust.sum() + np.sum((parameters / spread) ** 2)

    now = cost(chi2, parameters)
    for _ in range(rounds):
        w = weights(chi2, edges.width)
        info = edges.information * w[:, None, None]
        J = np.concatenate([A, B, M @ by], axis=2)  # [m, 3, 6+k]
        JW = np.einsum("nij,njk->nik", info, J)
        H = np.einsum("nij,nik->njk", J, JW)
        g = np.einsum("nij,ni->nj", JW, r)
        gradient = np.zeros(size)
        np.add.at(gradient, at.ravel(), g.ravel())
        gradient[3 * n :] += parameters / spread**2
        matrix = csc_matrix((H.ravel(), (rows, cols)), shape=(size, size))
        extra = np.zeros(size)
        extra[3 * anchor : 3 * anchor + 3] = 1e9
        extra[3 * n :] = 1 / spread**2
        while True:
            diagonal = matrix.diagonal() * damping + extra + 1e-9
            full = matrix + csc_matrix((diagonal, (np.arange(size), np.arange(size))), shape=(size, size))
            factor = splu(full, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
            step = -factor.solve(gradient)
            new = poses + step[: 3 * n].reshape(-1, 3)
            new_parameters = parameters + step[3 * n :]
            looked = look(new, new_parameters)
            then = cost(looked[4], new_parameters)
            if then <= now + 1e-9 or damping > 1e3:
                break
            damping = max(damping * 10, 1e-4)
        damping = max(damping / 10, 1e-9)
        poses, parameters = new, new_parameters
        r, A, B, M, chi2 = looked
        done = np.max(np.abs(step)) < tolerance
        now = then
        if done:
            break
    poses[:, 2] = wrap(poses[:, 2])
    return Solution(poses, parameters, chi2, weights(chi2, edges.width), factor)
