"""How good a map is (scores against a grid of what is really there, paths planned on it), and how good poses are."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int, Int8
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.geometry import compose, inverse, wrap
from echogrid.grid import Grid

if TYPE_CHECKING:
    from scipy.sparse import csr_array

FREE, SURFACE, HIDDEN = 0, 1, 2
"""What a cell of a truth grid can hold."""

OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.35
"""Probabilities past which a map claims a cell to be occupied or free."""

FALSE_DISTANCE_CELLS = 2.0
"""A claimed surface at most this far from a true one is inexact, not false."""

P_FLOOR = 0.001
"""The log-likelihood takes no probability to be nearer to 0 or 1 than this, or one cell would decide it."""

ECE_BINS = 15

PATH_STARTS, PATH_GOALS = 8, 8
"""Starts that are drawn for the path score, and goals for each."""

PATH_LEAST_M = 1.0
"""No start and goal are nearer than this on the shortest way between them."""


_SLACK_M = 1e-9
"""Distances that differ by rounding alone are equal."""


@dataclass(frozen=True)
class Truth:
    """What is really there, as far as it can be seen from a path.

    Indexed ``[row, col]``; row 0 is the lowest y, col 0 the lowest x.
    """

    cells: Int8[ndarray, "rows cols"]
    """1 = surface, 0 = free, 2 = hidden (left out of every score)."""
    resolution: float
    """Side of a cell, m."""
    origin: tuple[float, float]
    """World x, y of the lower left corner of cell [0, 0], m."""

    def __repr__(self) -> str:
        rows, cols = np.shape(self.cells)
        x, y = self.origin
        counts = ", ".join(
            f"{np.sum(self.cells == kind)} {name}"
            for kind, name in ((SURFACE, "surface"), (FREE, "free"), (HIDDEN, "hidden"))
        )
        return f"Truth({rows} x {cols} cells of {self.resolution:g} m from ({x:g}, {y:g}) m: {counts})"


@dataclass(frozen=True)
class PathScore:
    """What planning on a map comes to; nan where there is nothing to take a share of. See ``path_score``."""

    collides: float
    """Share of the paths planned on the map that hit a surface."""
    blocked: float
    """Share of the paths planned in the truth that hit something the map claims."""
    lost: float
    """Share of the pairs of start and goal between which the map shows no way, though there is one."""
    pairs: int
    """Number of pairs."""


@dataclass(frozen=True)
class Scores:
    """A map against a truth, in the order in which they are shown; nan where there is no cell to count.

    p is the map's probability at the centre of a truth cell, 0.5 outside the map. A neighbourhood is the 3x3
    truth cells round a cell; it takes in hidden cells, and reaches past the truth's border.
    """

    found: float
    """Share of surface cells with p > 0.65 somewhere in their neighbourhood."""
    wiped: float
    """Share of surface cells with p < 0.35 and no p > 0.65 in their neighbourhood: walls to drive into."""
    free: float
    """Share of free cells with p < 0.35."""
    false: float
    """Share with p > 0.65 of the free cells more than 2 cells (Euclid, by centres) from any surface."""
    auc: float
    """Area under the ROC curve, surface against free; a tie counts half."""
    nll: float
    """Mean of the two classes' mean negative log-likelihoods, nat; p clipped to [0.001, 0.999]."""
    brier: float
    """Mean of (p - y)^2 over surface (y = 1) and free (y = 0) cells, each cell with the same weight."""
    ece: float
    """Expected calibration error over the same cells: 15 equal bins of p, each weighted by its cells."""
    surface_cells: int
    """Number of surface cells."""
    free_cells: int
    """Number of free cells."""


def score(grid: Grid, truth: Truth) -> Scores:
    """The scores of a map against a truth; the two may differ in cell size and extent."""
    # scipy takes 0.6 s to import, which only scoring should cost: Truth is used wherever maps are written.
    from scipy.ndimage import maximum_filter

    padded = _sample(grid, truth, border=1)
    p = padded[1:-1, 1:-1]
    surface, free = truth.cells == SURFACE, truth.cells == FREE
    claimed_near = maximum_filter(padded, size=3)[1:-1, 1:-1] > OCCUPIED_ABOVE
    p_surface, p_free = p[surface], p[free]
    p_both = np.concatenate([p_surface, p_free])
    y_both = np.repeat([1.0, 0.0], [p_surface.size, p_free.size])
    return Scores(
        found=_mean(claimed_near[surface]),
        wiped=_mean((p_surface < FREE_BELOW) & ~claimed_near[surface]),
        free=_mean(p_free < FREE_BELOW),
        false=_mean(p[free & (_gap(surface) > FALSE_DISTANCE_CELLS)] > OCCUPIED_ABOVE),
        auc=_roc_area(p_surface, p_free),
        nll=_balanced_nll(p_surface, p_free),
        brier=_mean((p_both - y_both) ** 2),
        ece=_calibration_error(p_both, y_both),
        surface_cells=p_surface.size,
        free_cells=p_free.size,
    )


@dataclass(frozen=True)
class TrajectoryError:
    """Absolute error of a trajectory's poses, in the order in which it is shown. See ``trajectory_error``."""

    aligned_rms_m: float
    """Root mean square of the distances after the whole trajectory was laid onto the true one."""
    aligned_worst_m: float
    """The largest of them."""
    first_rms_m: float
    """Root mean square of the distances with the first pose laid onto the true first one."""
    first_worst_m: float
    """The largest of them."""
    heading_rms_deg: float
    """Root mean square of the headings' errors after the whole trajectory was laid onto the true one."""


def laid_onto(poses: Float[ndarray, "n 3"], truth: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """A trajectory (m, m, rad) moved as a whole so that its distances to the true one have the least squares."""
    middle, true_middle = poses[:, :2].mean(axis=0), truth[:, :2].mean(axis=0)
    p, q = poses[:, :2] - middle, truth[:, :2] - true_middle
    turn = float(np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q)))
    return compose(np.array([*true_middle, turn]), poses - [*middle, 0.0])


def trajectory_error(poses: Float[ndarray, "n 3"], truth: Float[ndarray, "m 3"]) -> TrajectoryError:
    """How far poses (m, m, rad) are from the true ones, pose by pose.

    The rigid motion that lays the trajectory onto the true one has the least squares of distances (Umeyama 1991
    without scale, in the plane), as of ``evo_ape tum TRUTH POSES -a``. Two differences: evo may also turn a plane
    upside down, where a mirrored trajectory fits better; and it lays none whose points are all on one line.

    Raises:
        InputError: other numbers of poses, or none, or such as are not finite.
    """
    for name, some in (("poses", poses), ("true poses", truth)):
        if np.shape(some) != np.shape(truth) or not np.size(some) or not np.all(np.isfinite(some)):
            raise InputError("trajectory", f"{name} of shape {np.shape(some)}", f"finite ones as {np.shape(truth)}")
    laid = laid_onto(poses, truth)
    first = compose(compose(truth[0], inverse(poses[0])), poses)
    off, first_off = (np.linalg.norm(some[:, :2] - truth[:, :2], axis=1) for some in (laid, first))
    return TrajectoryError(
        aligned_rms_m=_rms(off),
        aligned_worst_m=float(off.max()),
        first_rms_m=_rms(first_off),
        first_worst_m=float(first_off.max()),
        heading_rms_deg=float(np.rad2deg(_rms(wrap(laid[:, 2] - truth[:, 2])))),
    )


def _rms(values: Float[ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def check_overlap(grid: Grid, truth: Truth, map_name: str, truth_name: str) -> float:
    """Refuse to score a map by a truth of another place.

    Returns:
        The share of the truth's surface and free cells of whose centres the map speaks.

    Raises:
        InputError: nothing was observed, the truth has neither surface nor free cells, or the two have no cell in
            common.
    """
    seen = grid.observed_part()
    if seen is None:
        raise InputError(map_name, "a map in which nothing was observed", "some cells to score")
    counted = truth.cells != HIDDEN
    if not counted.any():
        raise InputError(truth_name, "hidden cells only", "some of surface (1) or free (0)")
    spoken = Grid(grid.observed.astype(np.float32), grid.observed, grid.resolution, grid.origin)
    share = float(np.mean(_sample(spoken, truth, border=0)[counted] > 0.5))
    if not share:
        found = f"a truth of another place, {_told(truth.resolution, truth.origin, truth.cells.shape)}"
        wanted = f"one of the place of the map, {_told(seen.resolution, seen.origin, seen.shape)}"
        raise InputError(truth_name, found, wanted)
    return share


def _told(resolution: float, origin: tuple[float, float], shape: tuple[int, ...]) -> str:
    (x, y), (rows, cols) = origin, shape
    return f"x {x:.2f} .. {x + cols * resolution:.2f}, y {y:.2f} .. {y + rows * resolution:.2f} m"


def path_score(grid: Grid, truth: Truth, robot_radius_m: float, seed: int = 0) -> PathScore:
    """What a robot meets that plans its way on the map, and what the map would keep it from.

    The path-based false negatives (``collides``) and false positives (``blocked``) of Collins, Collins & Ryan
    (Occupancy grid mapping: an empirical evaluation, MED 2007), with shortest paths for their A*. Other than there,
    a map that shows no way at all is told apart (``lost``): it would have no collisions otherwise.

    Starts and goals are free cells of the truth that keep the robot's radius and one cell more from all that is
    surface or hidden; of each start and goal the truth has a shortest way of at least PATH_LEAST_M. (By the way and
    not by the crow, for the two sides of a thin wall are the places that a lost wall joins.) They depend on the
    truth, the radius and the seed alone, so all maps are asked for the same ways.

    Paths go through the truth's cells to any of the eight neighbours, but not between two that touch at a corner
    when one of those beside is closed. The truth's go where it is free, the map's where p < 0.35; both keep the
    robot's radius from the centres of surface cells (truth: and hidden ones; map: cells with p > 0.65). A path
    hits where it goes through a surface (a cell with p > 0.65) or comes nearer to its centre than the radius less
    one cell, the larger of map and truth: a wall that is one cell off is inexact, not a collision. Only surface
    counts: what a path meets in hidden cells nobody knows.
    """
    from scipy.spatial import KDTree

    cell = max(grid.resolution, truth.resolution)
    # What lies beyond the truth's border is as little known as what is hidden.
    gap = _gap(np.pad(truth.cells != FREE, 1, constant_values=True))[1:-1, 1:-1] * truth.resolution
    surface = truth.cells == SURFACE
    surface_gap = _gap(surface) * truth.resolution
    p = _sample(grid, truth, border=0)
    claims = grid.centre_of(np.argwhere(grid.probability() > OCCUPIED_ABOVE))
    rows, cols = p.shape
    x, y = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    centres = np.stack([x, y], axis=-1) * truth.resolution + truth.origin
    # Between the map's own cells, for a wall of cells finer than the truth's must not be stepped over.
    claim_gap = KDTree(claims).query(centres)[0]

    def hits(solid: Bool[ndarray, "rows cols"], gap: Float[ndarray, "rows cols"]) -> Bool[ndarray, "rows cols"]:
        return solid | (gap < robot_radius_m - cell - _SLACK_M)

    rng = np.random.default_rng(seed)
    roomy = np.flatnonzero(gap >= robot_radius_m + truth.resolution - _SLACK_M)
    starts = rng.permutation(roomy)[:PATH_STARTS]
    real = _Ways((truth.cells == FREE) & (gap >= robot_radius_m - _SLACK_M), starts)
    pairs = []
    for i in range(len(starts)):
        length = real.length[i, roomy] * truth.resolution
        far = roomy[np.isfinite(length) & (length >= PATH_LEAST_M - _SLACK_M)]
        pairs += [(i, goal) for goal in rng.permutation(far)[:PATH_GOALS]]
    if not pairs:
        return PathScore(*[float("nan")] * 3, pairs=0)
    start, goal = np.transpose(pairs)
    shown = _Ways((p < FREE_BELOW) & (claim_gap >= robot_radius_m - _SLACK_M), starts)
    there = np.isfinite(shown.length[start, goal])
    return PathScore(
        collides=_mean(shown.meet(start[there], goal[there], hits(surface, surface_gap))),
        blocked=_mean(real.meet(start, goal, hits(p > OCCUPIED_ABOVE, claim_gap))),
        lost=_mean(~there),
        pairs=len(pairs),
    )


class _Ways:
    """The shortest ways from some starts to all cells, over the open cells of a grid."""

    def __init__(self, open_: Bool[ndarray, "rows cols"], starts: Int[ndarray, "starts"]):
        from scipy.sparse.csgraph import dijkstra

        self._cols = open_.shape[1]
        # The length in cells of the way from each start to each cell (flat index); inf: there is none.
        self.length, self._before = dijkstra(_lattice(open_), indices=starts, return_predecessors=True)

    def meet(
        self, start: Int[ndarray, "pairs"], goal: Int[ndarray, "pairs"], solid: Bool[ndarray, "rows cols"]
    ) -> Bool[ndarray, "pairs"]:
        """Whether the way from each start (its number) to a goal (flat index) goes through a solid cell.

        Or between two solid cells that touch at a corner.
        """
        flat = solid.ravel()
        here, met = goal, flat[goal]
        while np.any((back := self._before[start, here]) >= 0):
            back = np.where(back >= 0, back, here)
            beside = here - here % self._cols + back % self._cols, back - back % self._cols + here % self._cols
            met = met | flat[back] | (flat[beside[0]] & flat[beside[1]])
            here = back
        return met


def _lattice(open_: Bool[ndarray, "rows cols"]) -> "csr_array":
    """Steps between open cells (flat indices) and their eight neighbours, in cells; none past a closed corner."""
    from scipy.sparse import csr_array

    index = np.arange(open_.size).reshape(open_.shape)
    first, second, length = [], [], []
    for a, b, beside in [
        (np.s_[:, :-1], np.s_[:, 1:], []),
        (np.s_[:-1, :], np.s_[1:, :], []),
        (np.s_[:-1, :-1], np.s_[1:, 1:], [np.s_[:-1, 1:], np.s_[1:, :-1]]),
        (np.s_[:-1, 1:], np.s_[1:, :-1], [np.s_[:-1, :-1], np.s_[1:, 1:]]),
    ]:
        step = np.logical_and.reduce([open_[a], open_[b], *(open_[c] for c in beside)])
        first.append(index[a][step])
        second.append(index[b][step])
        length.append(np.full(step.sum(), np.sqrt(2.0) if beside else 1.0))
    i, j, steps = np.concatenate(first), np.concatenate(second), np.concatenate(length)
    return csr_array(
        (np.tile(steps, 2), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(open_.size, open_.size)
    )


def _sample(grid: Grid, truth: Truth, border: int) -> Float[ndarray, "rows cols"]:
    """``grid.probability_at`` the centres of the truth's cells and of ``border`` cells beyond, row by column.

    A cell's row depends on y alone and its column on x alone, so two lines of points do for the whole grid.
    """
    rows, cols = truth.cells.shape
    x = truth.origin[0] + (np.arange(-border, cols + border) + 0.5) * truth.resolution
    y = truth.origin[1] + (np.arange(-border, rows + border) + 0.5) * truth.resolution
    row = grid.index_of(np.stack([np.full_like(y, grid.origin[0]), y], axis=-1))[:, 0]
    col = grid.index_of(np.stack([x, np.full_like(x, grid.origin[1])], axis=-1))[:, 1]
    framed = np.pad(grid.probability().astype(float), 1, constant_values=0.5)
    return framed[np.ix_(np.clip(row, -1, grid.shape[0]) + 1, np.clip(col, -1, grid.shape[1]) + 1)]


def _gap(cells: Bool[ndarray, "rows cols"]) -> Float[ndarray, "rows cols"]:
    """Distance (Euclid, by centres, in cells) from each cell to the nearest of some; inf where there are none."""
    from scipy.ndimage import distance_transform_edt

    if not cells.any():
        return np.full(cells.shape, np.inf)
    return np.asarray(distance_transform_edt(~cells))


def _mean(values: ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _roc_area(p_surface: Float[ndarray, "n"], p_free: Float[ndarray, "m"]) -> float:
    """Chance that a surface cell outranks a free one, by the rank sum of Mann and Whitney (1947)."""
    from scipy.stats import rankdata

    n, m = p_surface.size, p_free.size
    if not n or not m:
        return float("nan")
    ranks = rankdata(np.concatenate([p_surface, p_free]))
    return float((ranks[:n].sum() - n * (n + 1) / 2) / (n * m))


def _balanced_nll(p_surface: Float[ndarray, "n"], p_free: Float[ndarray, "m"]) -> float:
    surface = _mean(-np.log(np.clip(p_surface, P_FLOOR, 1 - P_FLOOR)))
    free = _mean(-np.log1p(-np.clip(p_free, P_FLOOR, 1 - P_FLOOR)))
    return (surface + free) / 2


def _calibration_error(p: Float[ndarray, "n"], y: Float[ndarray, "n"]) -> float:
    """Sum over the bins of n_bin/n |mean y - mean p| (Naeini, Cooper & Hauskrecht 2015)."""
    if not p.size:
        return float("nan")
    bins = np.minimum((p * ECE_BINS).astype(int), ECE_BINS - 1)
    gap = np.bincount(bins, weights=y - p, minlength=ECE_BINS)
    return float(np.sum(np.abs(gap)) / p.size)
