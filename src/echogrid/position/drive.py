"""A drive whose pieces are placed one after the other: matches, loops, directions of walls, and a graph of all."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, transform, wrap
from echogrid.position import bends, walls
from echogrid.position.contradictions import Cells, Compared, cells, compared
from echogrid.position.graph import Edges, Solution, chi2, joined, residuals, solve
from echogrid.position.matching import FAIR, Field, Match, Seen, Target, match, seen
from echogrid.position.motion import PARAMETERS, Drift, chained, corrected, lengths, steps
from echogrid.position.pieces import LocalMaps, Patch, pieces
from echogrid.robot import Robot

BEFORE, ANCHOR, GROWN = 12, 4, 4
"""A piece is matched to the map of so many pieces before it, and its pose is told from the one so many before it. The
map grows by as many pieces as the last before it is made anew."""

CHAIN = np.array([12.0, 10.0, 16.0])
"""What the spread of such matches is multiplied with, along, across, heading: those that follow each other overlap
and err alike, along a corridor and in heading above all."""

CHAIN_SHARE, CHAIN_POSES = 0.3, 9
"""Of a piece's points on known ground that such a match needs, and along an axis how many poses it looks at."""

LOOP_GAP, LOOP_EVERY, LOOP_REACH_M, LOOPS = 16, 2, 6.0, 2
"""A loop is closed to pieces at least so many before (see ``Drive.loop_gap``), looked for at every second piece, at
most so far away, to at most two places."""

LOOP_SHARE, LOOP_AGREEMENT, LOOP_SURFACE, LOOP_SURFACE_SHARE = 0.5, 0.3, 0.1, 0.4
"""What a match must reach to close a loop, see ``Match``; without surfaces that agree all free floor is alike."""

UNIQUE = 0.6
"""Of a wide search that finds one place, see ``Match``; where several fit about as well none is taken."""

WIDE_M, WIDE_RAD = 0.25, np.deg2rad(6.0)
"""A guess that is spread farther is looked for with a longer piece of the drive."""

DOUBTED = np.array([0.4, 0.4, np.deg2rad(6.0)])
"""Standard deviations (m, m, rad) that a pose has besides, if a match where the graph has it fits badly."""

AMISS, APART, MOST_ROUNDS = np.array([1.0, 1.0, np.deg2rad(8.0)]), 20, 3
"""Standard deviations (m, m, rad) that a pose has besides where what was seen contradicts what other pieces saw, so
many before or after it at least, and how often that is looked for."""

SETTLED, LESS_AMISS = 0.7, 2 / 3
"""Of the loops that are closed then so many agree with each other and with all else that is known if they are right,
and at most so many of the pieces that contradicted others still do. In a corridor without marks many loops fit, and
each pulls it together by as much as it likes."""

BESIDE_M, TIED = 3.0, 8
"""Pieces that are so near to others, though far apart in time, see the same walls; they are loose if no loop begins
or ends within so many pieces of one, nor its walls were seen by the others."""

UNFAIR = 0.0
"""In place of ``matching.FAIR`` where a part of a drive must lie among what others saw."""

KERNEL = 4.0
"""Standard deviations beyond which a match counts less."""

COMPASS_RAD, COMPASS_EVERY, COMPASS_HALF, COMPASS_SURE_RAD = np.deg2rad(2.5), 3, 5, np.deg2rad(12.0)
"""How exact the direction of walls is, how often it is taken, over how many pieces to each side, and how well the
heading must be known, for a quarter turn must not be mistaken."""

RIGHT, LEAST_LOOPS, SURE = 2.4, 10, 1e-3
"""Odometry is right if of so many loops or more the half asks for no more, as squares in standard deviations, than if
it were true; then what is systematic in it has the last as its standard deviation."""

POINTS, WIDE_POINTS = 900, 1500

SOLVE_EVERY, SOLVE_ROUNDS = 2, 4

UNSURE, SHORT = 0.25, 200
"""A drive of whose loops more than this share were looked for widely may be wrong, and one of fewer pieces than the
last hardly shows it by contradicting itself."""

TRUST_ROUNDS, TRUST_EDGES, LEAST_TRUST = 12, 100, 0.05
"""Steps in which the error of odometry is found, from how many pieces, and the least of its drift that it has."""


class MatchEdge(NamedTuple):
    """A match of a piece as an edge of the graph."""

    first: int
    second: int
    pose: Float[ndarray, "3"]
    information: Float[ndarray, "3 3"]
    loop: bool


def _edges_of(matches: Sequence[MatchEdge]) -> Edges:
    """Matches, at least one, with their robust kernel."""
    first, second, pose, information, _ = (np.array(each) for each in zip(*matches, strict=True))
    return Edges(first, second, pose, information, np.full(len(matches), KERNEL))


def _squares(loops: Sequence[MatchEdge], poses: Float[ndarray, "pieces 3"]) -> Float[ndarray, "loops"]:
    """How far loops are off what poses say, squared, in standard deviations."""
    edges = _edges_of(loops)
    return chi2(residuals(poses, edges).off, edges.information)


def _fits(found: Match) -> bool:
    return (
        found.agreement >= LOOP_AGREEMENT
        and found.surface_agreement >= LOOP_SURFACE
        and found.surface_share >= LOOP_SURFACE_SHARE
    )


class Drive:
    """A drive whose pieces are placed one after the other; all that were placed before move with each."""

    loop_gap = LOOP_GAP
    """A loop is closed to pieces at least so many before."""

    def __init__(
        self,
        frames: Sequence[Frame],
        odometry: Float[ndarray, "frames 3"],
        robot: Robot,
        fair: float = FAIR,
        like: "Drive | None" = None,
    ):
        """A drive of which no piece is placed but the first.

        Args:
            frames: of the drive.
            odometry: their poses by odometry, m, m, rad.
            robot: that drove.
            fair: what new ground counts in loops that are looked for widely, see ``matching.FAIR``.
            like: the same drive, of which is taken what was found before pieces were placed.
        """
        self._fair, self._looked = fair, [0, 0]
        self._step = self._told = steps(odometry)
        self.cut = pieces(self._step)
        self.count = len(self.cut)
        self.poses = np.zeros((self.count, 3))
        self.parameters = np.zeros(PARAMETERS)
        self.matches: list[MatchEdge] = []
        self._drift, self._trust = Drift(), np.ones(3)
        self._rng = np.random.default_rng(0)
        self._maps = like._maps if like else LocalMaps(frames, self.cut, robot)
        self._near: tuple[int, Patch] | None = None
        self._sought: dict[range, tuple[Seen, bool]] = {}
        self._walls: dict[int, Float[ndarray, "points 2"]] = like._walls if like else {}
        self._seen: dict[int, tuple[Seen, bool]] = like._seen if like else {}
        self._headings: dict[int, float] = {}
        self._compass: float | None = None
        self._solution: Solution | None = None
        self._correct()
        if like:
            self._bias, self._points, self._cells = like._bias, like._points, like._cells
        else:
            self._points: list[Float[ndarray, "_ 2"]] = []
            self._cells: list[Cells] = []
            self._bias = self._bends()
        self._step = corrected(self._step, np.array([0.0, self._bias, 0.0]))
        self._correct()
        self._maps.forget_ways()
        self._information = self._odometry_information()

    def place(self, k: int) -> None:
        """Place the next piece."""
        self.poses[k] = compose(self.poses[k - 1], self._measured[k - 1])
        self._follow(k)
        if k % COMPASS_EVERY == 0 and k >= 2 * COMPASS_HALF:
            last = k - COMPASS_HALF
            begins = k < 2 * COMPASS_HALF + COMPASS_EVERY
            for m in range(last % COMPASS_EVERY if begins else last, last + 1, COMPASS_EVERY):
                self._look_along_walls(m)
        if k % LOOP_EVERY == 0 and self._solution is not None:
            self._close_loops(k)
        if k % SOLVE_EVERY == 0 or k == self.count - 1:
            self._solve(k + 1)

    def again(self) -> None:
        """Make all matches anew, with maps by what is known now of poses and odometry."""
        if self._solution is None:
            return
        self.matches, self._near = [], None
        for k in range(1, self.count):
            self._follow(k)
            if k % LOOP_EVERY == 0:
                self._close_loops(k)
        for m in range(0, self.count, COMPASS_EVERY):
            self._look_along_walls(m)
        self._solve(self.count, 20)

    def reconcile(self) -> Compared:
        """Look once more, and widely, where what was seen contradicts what was seen at other times: there the poses
        are less sure than the graph takes them to be. What does not settle it is undone.

        Returns:
            How what was seen lies together then.
        """
        told = self.compared()
        for _ in range(MOST_ROUNDS):
            if self._solution is None or not told.doubtful.any():
                break
            before = self.poses.copy(), self.parameters, len(self.matches)
            fair, self._fair = self._fair, UNFAIR
            for k in self._suspects(told)[::LOOP_EVERY].tolist():
                self._close_loops(k, AMISS)
                self._close_loops(k, AMISS, later=True)
            self._fair = fair
            if len(self.matches) == before[2]:
                break
            self._solve(self.count, 20)
            now = self.compared()
            if now.balance <= told.balance or not self._settled(self.matches[before[2] :], told, now):
                self.poses, self.parameters = before[:2]
                del self.matches[before[2] :]
                self._correct()
                self._solve(self.count)
                return self.compared()
            told = now
        return told

    def _settled(self, loops: Sequence[MatchEdge], before: Compared, now: Compared) -> bool:
        """Whether loops bring together what was seen, and not merely themselves."""
        agree = np.mean(_squares(loops, self.poses) <= KERNEL**2) >= SETTLED
        return bool(agree and now.doubtful.sum() <= LESS_AMISS * before.doubtful.sum())

    def _suspects(self, told: Compared) -> Int[ndarray, "suspects"]:
        """Pieces that contradict others, and the loose parts of the drive that such are in."""
        part, _ = ndimage.label(self.loose(told) | told.doubtful)
        return np.flatnonzero(np.isin(part, part[told.doubtful]))

    def loose(self, told: Compared) -> Bool[ndarray, "pieces"]:
        """Pieces that lie beside others and that nothing ties to them."""
        loose, number = ~told.joined, np.arange(self.count)
        for k in {k for edge in self.matches if edge.loop for k in (edge.first, edge.second)}:
            loose[max(k - TIED, 0) : k + TIED + 1] = False
        for k in np.flatnonzero(loose):
            near = np.hypot(*(self.poses[:, :2] - self.poses[k, :2]).T) < BESIDE_M
            loose[k] = np.any(near & (np.abs(number - k) >= APART))
        return loose

    def compared(self) -> Compared:
        """How what was seen at different times lies together."""
        return compared(self.poses, self._cells, APART)

    @property
    def drift(self) -> Float[ndarray, "3"]:
        """What corrects the odometry."""
        return self.parameters + np.array([0.0, self._bias, 0.0])

    def trust(self) -> None:
        """Believe odometry as far as it has proved right (expectation maximisation): its errors along, across and in
        heading are taken to be as large as what is known of all places says, with what that leaves open.
        """
        if self._solution is None:
            return
        if self._right():
            self._step, self._bias, self.parameters = self._told, 0.0, np.zeros(PARAMETERS)
            self._trust = np.full(3, LEAST_TRUST)
            self._drift = replace(self._drift, scale=SURE, bias=SURE, turning=SURE)
            self._correct()
            self._information = self._odometry_information()
            self._solve(self.count, 20)
            return
        some = np.unique(np.linspace(0, self.count - 2, TRUST_EDGES).astype(int))
        for _ in range(TRUST_ROUNDS):
            off = compose(inverse(self._measured[some]), steps(self.poses)[some])
            off[:, 2] = wrap(off[:, 2])
            left = np.array([np.diag(self._relative(k, k + 1)) for k in some.tolist()])
            squares = (off**2 + left) * self._information[some][:, [0, 1, 2], [0, 1, 2]]
            share = np.sqrt(squares.mean(axis=0))
            before, self._trust = self._trust, np.clip(self._trust * share, LEAST_TRUST, 1.0)
            if np.allclose(self._trust, before, rtol=0.03):
                return
            self._information = self._odometry_information()
            self._solve(self.count, 20)

    def _right(self) -> bool:
        """Whether the loops agree with the odometry as it was told."""
        loops = [edge for edge in self.matches if edge.loop]
        if len(loops) < LEAST_LOOPS:
            return False
        told = chained(np.zeros(3), self._told)[[piece.middle for piece in self.cut]]
        return bool(np.median(_squares(loops, told)) <= RIGHT)

    def edges(self, count: int) -> Edges:
        """What is known of the first so many pieces; a node behind them is the compass."""
        odometry = self._odometry_edges(count - 1)
        parts = [odometry]
        if self.matches:
            parts.append(_edges_of(self.matches))
        if self._headings:
            information = np.zeros((len(self._headings), 3, 3))
            information[:, 2, 2] = COMPASS_RAD**-2
            pose = np.array([[0.0, 0.0, heading] for heading in self._headings.values()])
            at, width = np.array(list(self._headings)), np.full(len(pose), 3.0)
            parts.append(Edges(np.full(len(pose), count), at, pose, information, width))
        return joined(parts)

    # What odometry says.

    def _correct(self) -> None:
        """Work out what odometry says with the parameters as they are now."""
        between, self.by_odometry = self._between(self.parameters)
        self._maps.drive = self.by_odometry
        self._measured = between
        self._by = np.zeros((self.count - 1, 3, PARAMETERS))
        small = 1e-4
        for k in range(PARAMETERS):
            change = self._between(self.parameters + small * np.eye(PARAMETERS)[k])[0] - between
            change[:, 2] = wrap(change[:, 2])
            self._by[:, :, k] = change / small

    def _odometry_edges(self, count: int) -> Edges:
        """From each of the first so many pieces to the next."""
        at, none = np.arange(count), np.full(count, np.inf)
        scale = np.zeros(count, dtype=int)
        return Edges(at, at + 1, self._measured[:count], self._information[:count], none, self._by[:count], scale)

    def _between(self, parameters: ndarray) -> tuple[Float[ndarray, "pairs 3"], Float[ndarray, "frames 3"]]:
        drive = chained(np.zeros(3), corrected(self._step, parameters))
        at = drive[[piece.middle for piece in self.cut]]
        return steps(at), drive

    def _odometry_information(self) -> Float[ndarray, "pairs 3 3"]:
        drift, middle = self._drift, np.array([piece.middle for piece in self.cut])
        covered = (np.concatenate([[0.0], np.cumsum(np.abs(each))]) for each in lengths(self._step))
        way, turn = (np.diff(each[middle]) for each in covered)
        heading = way * drift.heading**2 + turn * drift.turned**2 + drift.still[1] ** 2
        still = drift.still[0] ** 2
        variance = [way * drift.way**2 + still, way * drift.side**2 + still + heading * way**2 / 12, heading]
        information = np.zeros((self.count - 1, 3, 3))
        information[:, [0, 1, 2], [0, 1, 2]] = 1 / np.stack(variance, axis=1) / self._trust**2
        return information

    def _drifted(self, first: int, second: int) -> Float[ndarray, "3 3"]:
        """Covariance of the pose of a piece as seen from an earlier one, by odometry alone, roughly."""
        variance = np.sum(1 / self._information[first:second, [0, 1, 2], [0, 1, 2]], axis=0)
        way = float(np.abs(self._measured[first:second, 0]).sum())
        variance[:2] += variance[2] * way**2 / 3
        return np.diag(variance)

    def _bends(self) -> float:
        """The heading bias (rad/m) that odometry still has, by what was seen along the drive."""
        for k in range(len(self._points), self.count):
            self._points.append(walls.surface_points(self._own(k, True), bends.MOST_POINTS, self._rng))
            if k == len(self._cells):
                self._cells.append(cells(self._own(k, False)))
        return bends.heading_bias(self._step, self.cut, self._points)

    def unsure(self, together: Compared) -> bool:
        """Whether many of the loops were looked for widely, and how what was seen lies together does not show that
        they are right.
        """
        shown = self.count >= SHORT and not together.doubtful.any()
        return self._looked[1] > UNSURE * self._looked[0] and not shown

    def sharpness(self) -> float:
        """How well what was seen at different times lies together."""
        return bends.sharpness(self.poses, self._points, LOOP_GAP)

    # Matches.

    def _match(
        self,
        k: int,
        own: range,
        to: int,
        target: Patch,
        covariance: ndarray,
        points: int = POINTS,
        count: int = 11,
        wide: bool = False,
    ) -> Match | None:
        """Match what the pieces ``own`` saw from k to a map in the frame of piece ``to``."""
        what, far = self._what(k, own, points)
        if what.strength < 0.05:
            return None
        field = target.field(self.poses, far)
        guess = compose(inverse(self.poses[to]), self.poses[k])
        return match(Target(field), what, guess, covariance, count, wide, self._fair)

    def _what(self, k: int, own: range, points: int) -> tuple[Seen, bool]:
        """So many points at most of what pieces saw, from k, and whether there are far echoes among them."""
        if own == range(k, k + 1):
            if k not in self._seen:
                self._seen[k] = self._chosen(self._own(k, False), points, lambda _: self._own(k, True))
            return self._seen[k]
        if own not in self._sought:
            patch = self._maps.patch(self.poses[k])
            patch.add(own, self.poses)
            near = patch.field(self.poses, False)
            self._sought[own] = self._chosen(near, points, lambda near: patch.farther(near, own, self.poses))
        return self._sought[own]

    def _chosen(self, near: Field, points: int, farther: Callable[[Field], Field]) -> tuple[Seen, bool]:
        what = seen(near, points, self._rng)
        # Where little is near the echoes from far off are all that there is.
        far = what.strength < 0.5
        return (seen(farther(near), points, self._rng) if far else what), far

    def _follow(self, k: int) -> None:
        """Match a piece to the map of those before it."""
        to, patch = self._before(k)
        found = self._match(k, range(k, k + 1), to, patch, self._drifted(to, k), count=CHAIN_POSES)
        if found and found.share > CHAIN_SHARE:
            self.matches.append(MatchEdge(to, k, found.pose, found.information / np.outer(CHAIN, CHAIN), False))

    def _before(self, k: int) -> tuple[int, Patch]:
        """The map of the pieces before one, and the piece in whose frame it is."""
        if self._near is None or not self._near[0] + ANCHOR <= k < self._near[0] + ANCHOR + GROWN:
            to = max(0, k - ANCHOR)
            self._near = to, self._maps.patch(self.poses[to])
            begin = max(0, k - BEFORE)
        else:
            begin = self._near[1].pieces.stop
        to, patch = self._near
        patch.add(range(begin, k), self.poses)
        return to, patch

    def _close_loops(self, k: int, amiss: Float[ndarray, "3"] | None = None, later: bool = False) -> None:
        """Match a piece to the maps of places where the robot may have been long before.

        Args:
            k: the piece.
            amiss: standard deviations that its pose has beside those that the graph tells, m, m, rad.
            later: match those that came long after to it instead.
        """
        others = np.arange(k + self.loop_gap + 1, self.count) if later else np.arange(max(0, k - self.loop_gap))
        distance = np.hypot(*(self.poses[others, :2] - self.poses[k, :2]).T)
        self._sought.clear()
        tried: list[int] = []
        too_far: list[int] = []
        for near in np.argsort(distance).tolist():
            if len(tried) == LOOPS or distance[near] > LOOP_REACH_M:
                break
            j = int(others[near])
            # Those near one that is too far off are farther off and known no worse.
            if any(abs(j - other) < BEFORE for other in tried) or any(abs(j - other) < ANCHOR for other in too_far):
                continue
            first, second = min(j, k), max(j, k)
            covariance = self._relative(first, second)
            if amiss is not None:
                covariance = covariance + self._doubted(first, second, amiss)
            if distance[near] <= 1.5 + 2 * np.sqrt(np.max(np.linalg.eigvalsh(covariance[:2, :2]))):
                tried.append(j)
                self._close_loop(first, second, covariance)
            else:
                too_far.append(j)

    def _close_loop(self, j: int, k: int, covariance: Float[ndarray, "3 3"]) -> None:
        """Match a piece to the map round another; more of the drive, and more widely, where the pose is less sure or
        where what the graph says of it fits badly.
        """
        self._looked[0] += 1
        spread = np.sqrt(np.diag(covariance))
        target = self._maps.patch(self.poses[j])
        target.add(range(max(0, j - 8), min(j + 9, k - self.loop_gap // 2)), self.poses)
        if np.max(spread[:2]) <= WIDE_M and spread[2] <= WIDE_RAD:
            found = self._match(k, range(max(0, k - 2), k + 1), j, target, covariance)
            if found is None or found.share < LOOP_SHARE:
                return
            if _fits(found):
                self.matches.append(MatchEdge(j, k, found.pose, found.information, True))
                return
            covariance = covariance + self._doubted(j, k, DOUBTED)
        own = range(max(0, k - 8), k + 1)
        self._looked[1] += 1
        found = self._match(k, own, j, target, covariance, WIDE_POINTS, wide=True)
        if found and found.share >= LOOP_SHARE and _fits(found) and found.unique >= UNIQUE:
            self.matches.append(MatchEdge(j, k, found.pose, found.information, True))

    def _doubted(self, j: int, k: int, most: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
        """Covariance that the pose of piece k as seen from piece j may have besides: nowhere more than odometry
        leaves open, and no more than so many standard deviations (m, m, rad).
        """
        at = compose(inverse(self.poses[j]), self.poses[j : k + 1])
        variance = 1 / self._information[j:k, [0, 1, 2], [0, 1, 2]]
        cos, sin = np.cos(at[:-1, 2]), np.sin(at[:-1, 2])
        lever = at[-1, :2] - at[1:, :2]
        by = np.zeros((k - j, 3, 3))
        by[:, 0, :2], by[:, 1, :2] = np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)
        by[:, :2, 2] = np.stack([-lever[:, 1], lever[:, 0]], axis=-1)
        by[:, 2, 2] = 1
        drifted = np.einsum("nij,nj,nkj->ik", by, variance, by)
        drift = self._drift
        systematic = np.einsum("nij,njp->ip", by, self._by[j:k])
        systematic *= (drift.scale, drift.bias, drift.turning)
        drifted += systematic @ systematic.T
        return np.linalg.inv(np.linalg.inv(drifted) + np.diag(most**-2))

    # Headings by the direction of walls.

    def _look_along_walls(self, m: int) -> None:
        """Take the heading of a piece from the direction of the walls that it and its neighbours saw."""
        around = range(max(m - COMPASS_HALF, 0), min(m + COMPASS_HALF + 1, self.count))
        angle = walls.direction(np.concatenate([self._walls_from(m, k) for k in around]))
        if angle is None:
            return
        if self._compass is None:
            self._compass = float(self.poses[m, 2] + angle)
        heading = walls.nearest_quarter(self._compass - angle, float(self.poses[m, 2]))
        if self._headings:
            spread = self._heading_spread(m)
            off = abs(float(wrap(self.poses[m, 2] - heading)))
            if spread > COMPASS_SURE_RAD or off > 3 * max(spread, COMPASS_RAD):
                return
        self._headings[m] = heading

    def _own(self, k: int, far: bool) -> Field:
        """What a piece alone saw, in its own frame."""
        return self._maps.own(k, far)

    def _walls_from(self, m: int, k: int) -> Float[ndarray, "points 2"]:
        """Surface points of piece k as seen from piece m."""
        if k not in self._walls:
            self._walls[k] = walls.surface_points(self._own(k, False), walls.MOST_POINTS, self._rng)
        return transform(compose(inverse(self.poses[m]), self.poses[k]), self._walls[k])

    def _heading_spread(self, m: int) -> float:
        last = min(m, self._placed - 1)
        variance = self._solved.covariance([last])[0, 0, 2, 2]
        return float(np.sqrt(variance + (self._drifted(last, m)[2, 2] if m > last else 0.0)))

    # The graph.

    @property
    def _solved(self) -> Solution:
        assert self._solution is not None
        return self._solution

    @property
    def _placed(self) -> int:
        """Pieces in the graph when it was last solved; the node behind them is the compass."""
        return len(self._solved.poses) - 1

    def _solve(self, count: int, rounds: int = SOLVE_ROUNDS) -> None:
        """Bring all pieces that were placed to where all that is known of them agrees best."""
        spread = np.array([self._drift.scale, self._drift.bias, self._drift.turning])
        nodes = np.concatenate([self.poses[:count], np.zeros((1, 3))])
        self._solution = solve(nodes, self.edges(count), self.parameters, spread, rounds)
        self.poses[:count] = self._solution.poses[:-1]
        self.parameters = self._solution.parameters
        self._correct()

    def _relative(self, j: int, k: int) -> Float[ndarray, "3 3"]:
        """Covariance of the pose of piece k as seen from piece j, in its frame."""
        last = min(k, self._placed - 1)
        blocks = self._solved.covariance([j, last])
        pair = self.poses[[j, last]]
        seen = compose(inverse(pair[0]), pair[1])
        one = Edges(np.array([0]), np.array([1]), seen[None], np.eye(3)[None], np.array([np.inf]))
        told = residuals(pair, one)
        by = np.concatenate([told.by_first[0], told.by_second[0]], axis=1)
        cos, sin = np.cos(seen[2]), np.sin(seen[2])
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ by
        covariance = turn @ np.block([[blocks[0, 0], blocks[0, 1]], [blocks[1, 0], blocks[1, 1]]]) @ turn.T
        return covariance + self._drifted(last, k) if k > last else covariance
