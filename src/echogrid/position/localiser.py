"""Where a robot is in a map that is known, from its ranges and odometry that drifts: a particle filter."""

from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.grid import Grid
from echogrid.mapping.intake import check_robot, cleaned, fitting
from echogrid.mapping.registry import DEFAULT, sensor_model
from echogrid.position.beams import FREE, Beams
from echogrid.position.floor import Walls, check_start, in_map
from echogrid.position.motion import Drift, broken, lengths
from echogrid.position.particles import Particles, Place
from echogrid.position.sights import Ground, sight
from echogrid.position.usual import Usual
from echogrid.robot import Robot

_PIECE_M, _PIECE_RAD = 0.4, 0.8
"""What is seen is weighed each time the robot has driven or turned so far."""

_SCANS, _MOST_FRAMES = 4, 40
"""Scans of a piece that are compared reading by reading, and those that are seen together."""

_SHARP, _SHARP_BEAMS = 60.0, 0.2
"""What the agreement of a sight counts as a log-likelihood, and what that of a reading does: cells and readings are
far from independent of each other. Both measured on simulated drives in flats, rings and halls."""

_TEMPER = 0.05
"""What evidence counts while several places are possible: the wrong one must not win by a lucky piece."""

_THROUGH = 4.0
"""What a way through a wall counts against it, as a log-likelihood: maps have walls where there are doors now."""

_POINTS, _POINTS_MANY, _MANY = 500, 300, 5000
"""Points of a sight; of so many particles fewer will do."""

_LEAST, _MOST, PER_M2 = 1000, 200_000, 400.0
"""Particles: at least, at most, and to begin with where the place is not known."""

_PER_M2_RIVALS, _MOST_RIVALS = 80, 8_000
"""Of those that look for another place while one is sure."""

START_SPREAD = np.array([0.15, 0.15, np.deg2rad(7.0)])
"""Standard deviations of a start that is given, m, m, rad."""

HEAP_M, HEAP_RAD = 0.5, np.deg2rad(25.0)
"""Particles within this of their middle are at one place."""

_SURE, _FOR, _LEAST_WAY_M = 0.98, 4, 2.0
"""The place is sure when this share of all weight has been at one for so many pieces, and so long a way."""

FAIR = 0.2
"""Mean agreement of what is seen with a map (as of ``Ground``) below which no place found counts as sure: it was .24
to .47 where the place is right, .19 to .27 in a plan without its furniture, up to .2 in maps of other buildings."""

_STILL_HERE = 0.2
"""Share of the weight that stays at a place that was doubted: it may be right, and the world have changed."""

_CHANCE, _AT_RANDOM, _LOST = 0.85, 300, 6
"""A place is wrong where for so many pieces more than not it agreed worse than this share of places at random, or led
through a wall, or worse than is usual by far."""


@dataclass(frozen=True)
class Estimate:
    """Where the robot is."""

    stamp: float
    """s"""
    pose: Float[ndarray, "3"]
    """In the map, m, m, rad; the likeliest place where several are possible."""
    covariance: Float[ndarray, "3 3"]
    """Of the particles there."""
    share: float
    """Of all weight that is there."""
    sure: bool
    """Whether no other place remains."""


class Event(NamedTuple):
    """Something that happened to a localiser."""

    what: Literal["sure", "lost", "jump", "anew"]
    """One place remains; it does not explain what is seen, and all are possible again; the odometry jumps, which is
    taken for a start anew where the robot is; time goes back with it, and the drive begins again where it did."""
    stamp: float
    """s"""
    driven_m: float
    """Since the first frame."""
    frame: int
    """Number of the frame, from 0."""


class Localiser:
    """Finds a robot in a map, scan by scan.

    localiser = Localiser(read_map("map.yaml"), robot, start=(1.0, 2.0, 0.5))
    for frame in log:
        estimate = localiser.add(frame)
    """

    def __init__(
        self,
        grid: Grid,
        robot: Robot,
        start: Float[ndarray, "3"] | Sequence[float] | None = None,
        seed: int = 0,
        per_m2: float = PER_M2,
    ) -> None:
        """A robot that has not moved.

        Args:
            grid: the map.
            robot: the robot.
            start: about where it stands in the map, m, m, rad; None: anywhere.
            seed: of the particles; the same one gives the same poses.
            per_m2: particles to begin with where the place is not known.

        Raises:
            UsageError: no such robot, a map without floor, or a start that is not on its floor.
        """
        check_robot(robot)
        check_start(grid, start)
        self._robot, self._model, self._drift = robot, sensor_model(DEFAULT), Drift()
        floor = np.argwhere(grid.observed & (grid.probability() < FREE))
        self._floor, self._floor_m2 = grid.centre_of(floor), len(floor) * grid.resolution**2
        self._grid, self._cell = grid, grid.resolution
        self._ground, self._beams, self._walls = Ground(grid), Beams(grid, robot), Walls(grid, _PIECE_M)
        self._seed, self._rng, self._per_m2 = seed, np.random.default_rng(seed), per_m2
        self._forget()
        self._start = None if start is None else np.asarray(start, dtype=float)
        self.begin(self._start)

    def _forget(self) -> None:
        """Know of no drive."""
        self._usual = Usual()
        self.events: list[Event] = []
        """What happened so far."""
        self._frames: deque[Frame] = deque(maxlen=_MOST_FRAMES * 16)
        self._last: Frame | None = None
        self._count, self._driven = 0, 0.0
        self._pieces, self._explained, self._agreed = 0, 0.0, np.zeros(2)

    def _gather(self, start: Float[ndarray, "3"], spread: Float[ndarray, "3"] = START_SPREAD) -> None:
        """Be near a pose, with standard deviations as given (m, m, rad)."""
        self._particles = self._guesses(start + self._rng.standard_normal((2 * _LEAST, 3)) * spread)
        self._sure, self._certain, self._alone, self._bad = True, _FOR, np.zeros(2), 0
        self._begin_rivals()
        self._place = Place(start, np.diag(spread**2), 1.0)

    def _spread(self) -> None:
        """Be anywhere on the floor."""
        self._particles = self._guesses(
            self._anywhere(int(np.clip(self._per_m2 * self._floor_m2, 2 * _LEAST, _MOST)))
        )
        self._sure, self._certain, self._alone, self._bad = False, 0, np.zeros(2), 0
        self._since = self._driven
        self._place = self._particles.place((HEAP_M, HEAP_RAD))

    def _doubt(self) -> None:
        """Be anywhere on the floor, or still here."""
        here = self._particles
        self._spread()
        here.weights = here.weights * _STILL_HERE
        self._particles.weights = self._particles.weights * (1 - _STILL_HERE)
        self._particles = self._particles.joined(here)

    def _guesses(self, poses: Float[ndarray, "n 3"]) -> Particles:
        return Particles(poses, self._rng.normal(0, self._drift.bias, len(poses)))

    def _anywhere(self, count: int) -> Float[ndarray, "n 3"]:
        at = self._floor[self._rng.integers(len(self._floor), size=count)]
        at = at + self._rng.uniform(-0.5, 0.5, at.shape) * self._cell
        return np.column_stack([at, self._rng.uniform(-np.pi, np.pi, count)])

    def _begin_piece(self) -> None:
        self._net, self._way, self._turn = np.zeros(3), 0.0, 0.0

    def put(self, pose: Float[ndarray, "3"], spread: Float[ndarray, "3"] = START_SPREAD) -> None:
        """Be told where the robot is now, in the middle of a drive.

        Args:
            pose: in the map, m, m, rad.
            spread: standard deviations of that, m, m, rad.

        Raises:
            UsageError: it is outside of the map; nothing is changed.
        """
        in_map(self._grid, pose)
        self._frames.clear()
        self._begin_piece()
        self._gather(np.asarray(pose, dtype=float), spread)

    def begin(self, start: Float[ndarray, "3"] | None = None) -> None:
        """Begin anew at a start (m, m, rad), or anywhere: nothing that was heard before counts."""
        self._frames.clear()
        self._last = None
        self._begin_piece()
        if start is None:
            self._spread()
        else:
            self._gather(start)

    def equip(self, robot: Robot) -> None:
        """Go on with a robot that has got more sonars, behind those that it had."""
        check_robot(robot)
        self._frames.clear()
        self._robot, self._beams = robot, Beams(self._grid, robot)

    def at(self, pose: Float[ndarray, "3"], spread: Float[ndarray, "3"] = START_SPREAD) -> "Localiser":
        """Another localiser in the same map, whose robot stands at a pose, with standard deviations (m, m, rad)."""
        other = copy(self)
        other._rng = np.random.default_rng(self._seed)
        other._forget()
        other._begin_piece()
        other._gather(pose, spread)
        return other

    @property
    def sure(self) -> bool:
        """Whether one place remains."""
        return self._sure

    @property
    def driven_m(self) -> float:
        """Length of the way since the first frame."""
        return self._driven

    @property
    def pieces(self) -> int:
        """How often what was seen has been weighed."""
        return self._pieces

    @property
    def explained(self) -> float:
        """How well the place has agreed with all that was seen, as a log-likelihood; drives can be compared by it."""
        return self._explained

    @property
    def agreement(self) -> float:
        """Mean agreement, as of ``Ground``, of what was seen while the place was sure with the map there.

        Less than FAIR is little; nan where nothing was seen.
        """
        agreed, strength = self._agreed
        return float(agreed / strength) if strength > 0 else np.nan

    @property
    def particles(self) -> Particles:
        """The guesses as they were after the last piece."""
        return self._particles

    def add(self, frame: Frame) -> Estimate:
        """Go on to a frame, whose pose is by odometry.

        Raises:
            UsageError: it cannot be one of the robot's; nothing is changed.
        """
        (frame,) = cleaned(list(fitting([frame], self._robot)), self._robot)
        step = self._step_to(frame)
        way, turn = (float(each[0]) for each in lengths(step[None]))
        self._net = compose(self._net, step)
        self._way, self._turn, self._driven = self._way + way, self._turn + turn, self._driven + abs(way)
        self._frames.append(frame)
        self._last = frame
        if abs(self._way) > _PIECE_M or self._turn > _PIECE_RAD:
            self._look()
            self._begin_piece()
        self._count += 1
        place = self._place
        return Estimate(frame.stamp, compose(place.pose, self._net), place.covariance, place.share, self._sure)

    def _step_to(self, frame: Frame) -> Float[ndarray, "3"]:
        """The way from the last frame by odometry; none where that jumps."""
        if self._last is None:
            return np.zeros(3)
        took = frame.stamp - self._last.stamp
        if not broken(self._last.pose, frame.pose, took):
            return compose(inverse(self._last.pose), frame.pose)
        if took <= 0:
            self._note("anew", frame)
            self.begin(self._start)
        else:
            self._note("jump", frame)
            self._frames.clear()
        return np.zeros(3)

    def _note(self, what: Literal["sure", "lost", "jump", "anew"], frame: Frame) -> None:
        self.events.append(Event(what, frame.stamp, self._driven, self._count))

    def _look(self) -> None:
        """Move the particles along the piece, and weigh them by what it saw."""
        particles, rng = self._particles, self._rng
        rivals = self._rivals if self._sure else None
        through = self._move(particles)
        barred = self._move(rivals) if rivals is not None else np.zeros(0, dtype=bool)
        groups = [particles.poses, self._anywhere(_AT_RANDOM), *([] if rivals is None else [rivals.poses])]
        ground, strength, evidence = self._evidence(np.concatenate(groups))
        here, elsewhere, there = np.split(evidence, [len(particles), len(particles) + _AT_RANDOM])
        passed = float(particles.weights @ through)
        particles.reweight(here * (1.0 if self._sure else _TEMPER) - _THROUGH * through)
        chance = float(np.quantile(elsewhere, _CHANCE))
        agreement = float(particles.weights @ here)
        agreed = np.array([particles.weights @ ground[: len(particles)], strength])
        agrees = bool(passed < 0.5 and agreement > chance) and not self._usual.poor(agreement)
        if particles.effective() < len(particles) / 2:
            particles.resample(_LEAST, _MOST, rng)
        self._place = particles.place((HEAP_M, HEAP_RAD))
        self._frames.clear()
        self._pieces, self._explained = self._pieces + 1, self._explained + agreement - _THROUGH * passed
        self._agreed = self._agreed + agreed * self._sure
        if np.ptp(evidence) > 0:  # else it saw nothing
            self._judge(agrees, agreed)
            if self._sure and agrees:
                self._usual.add(agreement)
        if rivals is not None and self._sure:
            rivals.reweight(there * _TEMPER - _THROUGH * barred)
            self._compete(rivals, float(rivals.weights @ there) - agreement)

    def _move(self, particles: Particles) -> Bool[ndarray, "n"]:
        """Move particles along the piece; which of them went through a wall."""
        before = particles.poses[:, :2]
        particles.propagate(self._net, self._way, self._turn, self._drift, self._rng)
        return self._walls.crossed(before, particles.poses[:, :2])

    def _compete(self, rivals: Particles, better: float) -> None:
        """Whether another place that was found anew explains more than the one that was sure.

        Args:
            rivals: particles that began anywhere while the place was sure, weighed.
            better: by how much they agree better with this piece than the place does.
        """
        frame = self._last
        assert frame is not None
        if rivals.effective() < len(rivals) / 2:
            rivals.resample(_LEAST, _MOST_RIVALS, self._rng)
        place = rivals.place((HEAP_M, HEAP_RAD))
        self._better = 0.7 * self._better + better
        self._found = self._found + 1 if place.share >= _SURE else 0
        if self._found < 2 * _FOR:
            return
        off = np.hypot(*(place.pose - self._place.pose)[:2])
        if off > 2 * HEAP_M and self._better > 0:
            self._note("lost", frame)
            self._particles, self._place, self._bad = rivals, place, 0
            self._note("sure", frame)
        self._begin_rivals()

    def _begin_rivals(self) -> None:
        """Look for the robot anywhere, whatever is sure."""
        count = int(np.clip(_PER_M2_RIVALS * self._floor_m2, 2 * _LEAST, _MOST_RIVALS))
        self._rivals, self._found, self._better = self._guesses(self._anywhere(count)), 0, 0.0

    def _evidence(self, poses: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, "n"], float, Float[ndarray, "n"]]:
        """Agreement of the piece's sight from poses at its end, its strength, and log-likelihood of all it heard."""
        frames = list(self._frames)
        points = _POINTS if len(poses) < _MANY else _POINTS_MANY
        seen = sight(_evenly(frames, _MOST_FRAMES), self._robot, self._model, points, self._rng)
        ground = self._ground.agreement(seen, poses)
        evidence = _SHARP * ground
        end = inverse(frames[-1].pose)
        for frame in _evenly(frames, _SCANS):
            mounts = self._robot.mounts if frame.mounts is None else frame.mounts
            mounts = compose(compose(end, frame.pose), mounts)
            evidence += _SHARP_BEAMS * self._beams.log_likelihood(poses, frame.ranges, mounts)
        return ground, seen.strength, evidence

    def _judge(self, agrees: bool, agreed: Float[ndarray, "2"]) -> None:
        """Whether one place remains, and explains what is seen.

        Args:
            agrees: whether it explains the last piece.
            agreed: how well the piece's sight agrees with the map there, and the sight's strength.
        """
        frame = self._last
        assert frame is not None
        alone = self._place.share >= _SURE
        self._certain = self._certain + 1 if alone and agrees else 0
        self._alone = self._alone + agreed if alone else np.zeros(2)
        fair = self._alone[0] >= FAIR * self._alone[1]
        self._bad = max(0, self._bad - 1) if agrees else self._bad + alone
        if self._bad >= _LOST:
            self._note("lost", frame)
            self._doubt()
        elif not self._sure and fair and self._certain >= _FOR and self._driven - self._since >= _LEAST_WAY_M:
            self._sure = True
            self._begin_rivals()
            self._particles.keep(self._place, (HEAP_M, HEAP_RAD))
            self._note("sure", frame)


def _evenly(frames: list[Frame], most: int) -> list[Frame]:
    """At most so many frames, spread evenly, the last among them."""
    if len(frames) <= most:
        return frames
    return [frames[i] for i in np.linspace(len(frames) - 1, 0, most, endpoint=False).astype(int)[::-1]]
