"""The compiled core; its sources lie in core/ of the repository.

Arrays of another type than is named are converted, those of whole numbers apart. While a function computes, other
threads of Python run.
"""

from collections.abc import Sequence

from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64
from numpy import ndarray

def instructions() -> str:
    """The instructions that the kernels use: "v2", "v3" or "v4" of x86-64, "neon" or "baseline".

    They are the widest that this machine has, unless the environment variable ECHOGRID_INSTRUCTIONS names others
    when a kernel is first used.

    Raises:
        UsageError: the machine does not have those that the variable names, or none that the core was built for.
    """

def threads() -> int:
    """How many threads the core uses: at first, as many as the process may run on. No result depends on it."""

def set_threads(count: int) -> None:
    """Set the number of threads.

    Raises:
        UsageError: it is not in 1 to 256.
    """

class PoseScorer:
    """A map that poses are scored against; the map is copied."""

    def __init__(self, b: Float[ndarray, "rows cols"], origin: tuple[float, float], resolution: float) -> None:
        """Take a map.

        Args:
            b: 2 p - 1 of each cell's probability p, float32; 0 where nothing is known.
            origin: x, y of the lower left corner of cell [0, 0], m.
            resolution: side of a cell, m.

        Raises:
            UsageError: a value lies outside of -1 to 1, or the map has 2^31 cells.
        """

    def score(
        self, points: Float[ndarray, "n 2"], a: Float[ndarray, "n"], poses: Float[ndarray, "poses 3"]
    ) -> Float32[ndarray, "poses"]:
        """How well what was seen agrees with the map, for each pose it may have been seen from.

        The sum of log(1 + a b) over all points, b being bilinear between the centres of the map's cells, and 0
        outside of the map. A term is at least -24 log 2 = -16.6.

        Args:
            points: x, y in the robot's frame, m, float32.
            a: 2 p - 1 of each point, float32.
            poses: x, y, heading of the robot in the map's frame, m and rad, float64.

        Raises:
            UsageError: a value is not finite, an ``a`` lies outside of -1 to 1, or a shape is another.
        """

def cost_to_go(
    costs: Float[ndarray, "rows cols"], goals: Int64[ndarray, "goals 2"], resolution: float
) -> Float64[ndarray, "rows cols"]:
    """What it costs to get from each cell to that goal which costs least; inf where there is no way to any.

    A step leads to one of the eight cells around and costs its length times the mean of the costs of its two cells.
    No corner is cut: a diagonal step needs both the cells beside it open. Exact but for the rounding of float64.

    Args:
        costs: of a metre in each cell, float32, >= 0; inf where it is closed.
        goals: cells [row, col], int64 as it is; one that is closed is none.
        resolution: side of a cell, m.

    Raises:
        UsageError: a cost is negative or nan, a goal lies outside, or the map has 2^31 cells.
    """

def distance(marked: Bool[ndarray, "rows cols"]) -> Float32[ndarray, "rows cols"]:
    """How far each cell is from the nearest that is marked, in cells, between their middles; inf without any.

    Exact but for the rounding of float32 (Meijster, Roerdink & Hesselink 2000).

    Raises:
        UsageError: the map has 2^31 cells.
    """

class SonarArray:
    """An array of sonars, and what it fixes of the set network's polar table."""

    def __init__(
        self,
        mounts: Float64[ndarray, "sonars 3"],
        max_range: Float32[ndarray, "sonars"],
        footprint: float,
        half_beam: float,
        ends: bool,
    ) -> None:
        """An array.

        Args:
            mounts: forward and left, m, and axis, rad, of each; nan: no such sonar.
            max_range: of each, m.
            footprint: radius of the robot, m.
            half_beam: half the beam width, rad.
            ends: whether what a sonar tells ends at its range.

        Raises:
            UsageError: arrays of other shapes, or no beam.
        """

class PolarTables:
    """What scans tell of bearings and rings round the robot."""

    def values(self) -> Float32[ndarray, "scans 64 51"]:
        """Log-odds at bearings and rings, a copy; 0 where no sonar that fired looks."""

    def told_until(self) -> Float32[ndarray, "scans 64"]:
        """How far from the robot's middle scans tell, from each bearing to the next, m; a copy."""

    def at(
        self, x: Float32[ndarray, "scans points"], y: Float32[ndarray, "scans points"]
    ) -> Float32[ndarray, "scans points"]:
        """What each scan tells of points in the robot's frame (m), log-odds; 0 = nothing, as beyond 2.5 m."""

    def add(
        self,
        corner: Float32[ndarray, "scans 2"],
        heading: Float64[ndarray, "scans"],
        first: Int32[ndarray, "scans 2"],
        weight: Float32[ndarray, "scans"],
        cell: float,
        sums: Sequence[Float32[ndarray, "rows cols"]],
        views: Int32[ndarray, "rows cols"],
    ) -> None:
        """Add scans to a window of the map, in their order.

        Args:
            corner: centre of the first cell of each scan's patch, from the robot, world axes, m.
            heading: of the robot, rad.
            first: row and column of that cell in the window.
            weight: what each scan counts; of those that count nothing nothing is added.
            cell: side of a cell, m.
            sums: evidence for a surface and against it, the same of its squares, looks. Written to, as ``views``;
                views of larger arrays, all of the same strides.
            views: scans that spoke of each cell.

        Raises:
            UsageError: arrays of other shapes, a window of fewer than 16 columns.
        """

class SetNetwork:
    """The set network with its weights. Calls run side by side where other threads hold no lock of Python's."""

    def __init__(self, weights: Float32[ndarray, "n"], units: int) -> None:
        """A network of so many units, its weights one after the other, see core/set_network.hpp."""

    def surround(self, parts: Sequence[Float32[ndarray, "_"]], units: int, passed: int, cell_units: int) -> None:
        """Let cells be read with their surroundings: weights of the stack, see core/surroundings_types.hpp."""

    def tables(
        self,
        array: SonarArray,
        ranges: Float32[ndarray, "scans sonars"],
        traits: Float32[ndarray, "scans 4"],
        mounts: Float64[ndarray, "scans sonars 3"] | None = None,
    ) -> PolarTables:
        """What scans tell.

        Args:
            array: of the robot.
            ranges: m; inf: no echo, nan: not fired.
            traits: of the surroundings, see ``Memory``.
            mounts: from where the sonars of each scan looked; None: as in the array.
        """

    def read_out(
        self,
        held: Sequence[Float32[ndarray, "rows cols"]],
        held_at: tuple[int, int],
        squares: tuple[int, int],
        begin: Float32[ndarray, "units"],
        faded: float,
        least: float,
        stood: float,
        log_odds: Float32[ndarray, "out_rows out_cols"],
        observed: Bool[ndarray, "out_rows out_cols"],
        out_at: tuple[int, int],
    ) -> None:
        """Read out cells of a rectangle, whose first cell has even indices in the world.

        Args:
            held: sums as of ``PolarTables.add``, and where the robot stood; nothing is known of the others.
            held_at: row and column of the rectangle at which they begin.
            squares: rows and columns of the rectangle, in squares of 2 x 2 cells.
            begin: what the robot's sonars add to the first layer of the surroundings.
            faded: what evidence has come to count.
            least: evidence that counts no more than this is none.
            stood: log-odds, at most, of floor on which the robot has stood.
            log_odds: written to.
            observed: likewise: where anything is known.
            out_at: row and column of the rectangle at which they begin.
        """

class Memory:
    """What a robot remembers of where it looked from, and of what its surroundings are like; see models.networks."""

    def __init__(
        self,
        pairs: Int32[ndarray, "pairs 2"],
        near: Float64[ndarray, "pairs"],
        sonars: int,
        place: float,
        turn: float,
        far: float,
        same: float,
        fade: float,
        prior: float,
        half_life: float | None = None,
    ) -> None:
        """A new drive.

        Args:
            pairs: sonars whose readings are compared.
            near: how much each pair counts.
            sonars: how many there are.
            place: side of a cell of the lattice of poses that see the same, m.
            turn: likewise of headings, rad.
            far: readings beyond are all alike, m.
            same: readings farther apart do not agree, m.
            fade: what an earlier scan counts, for each scan since, in the traits.
            prior: what counts for one half from the beginning.
            half_life: time in which a look comes to count half, s; None: it counts for ever.
        """

    def take(
        self,
        poses: Float64[ndarray, "scans 3"],
        ranges: Float64[ndarray, "scans sonars"],
        stamps: Float64[ndarray, "scans"],
        new: Float64[ndarray, "scans"],
    ) -> tuple[Float32[ndarray, "scans"], Float32[ndarray, "scans 4"]]:
        """Add scans, and give what each counts and its traits, see ``models.networks.memory.Memory``."""

class Recent:
    """The last scans of a drive."""

    def __init__(
        self, mounts: Float64[ndarray, "sonars 3"], way: float, turn: float, time: float, scans: int
    ) -> None:
        """A new drive.

        Args:
            mounts: of the robot's sonars, m and rad; nan: no such sonar.
            way: how far off, at most, a scan was made that others are completed from, m.
            turn: likewise, rad.
            time: likewise, s.
            scans: how many are kept.
        """

    def complete(
        self,
        stamp: float,
        pose: Float64[ndarray, "3"],
        ranges: Float64[ndarray, "sonars"],
        mounts: Float64[ndarray, "sonars 3"] | None = None,
    ) -> tuple[Float64[ndarray, "sonars"], Float64[ndarray, "sonars 3"], float] | None:
        """A scan that follows, with what its silent sonars heard last.

        Returns:
            Ranges, mounts and what share of the readings is new; None where no sonar is silent that was heard.
        """

def stand(
    way: Float64[ndarray, "poses 2"],
    came: bool,
    radius: float,
    cell: float,
    step: float,
    gap: float,
    weight: float,
    stood: Float32[ndarray, "rows cols"],
    begin: tuple[int, int],
) -> tuple[int, int, int, int] | None:
    """Note the floor over which a robot came.

    Args:
        way: x, y of the robot, m.
        came: whether the first of them was noted before.
        radius: of what is sure to have been under it, m.
        cell: side of a cell, m.
        step: the way between poses is followed in steps of this, m,
        gap: unless it is longer than this, m.
        weight: cells come to hold at least this.
        stood: written to; cells outside of it are left out.
        begin: its first cell [row, col], counted from the world's origin.

    Returns:
        First cell that was covered and that behind the last: row, col, row, col; None: there is none.
    """

def add_rays(
    from_: Float64[ndarray, "fans 2"],
    angles: Float64[ndarray, "fans rays"],
    first: Float64[ndarray, "fans"],
    step: float,
    counts: Int64[ndarray, "fans"],
    change: float,
    corner: tuple[float, float],
    cell: float,
    cells: Float64[ndarray, "rows cols"],
) -> None:
    """Add to the cells in which points of rays lie, once for each point; those outside of the map are left out.

    Args:
        from_: x, y where the rays of each fan begin, m.
        angles: along which they lead, rad.
        first: how far along it the first point of each ray of a fan is, m.
        step: from point to point, m.
        counts: points of each ray of a fan.
        change: is added.
        corner: lower left corner of the map, m.
        cell: side of a cell, m.
        cells: written to.

    Raises:
        UsageError: arrays of other shapes, no cell.
    """

class PaperNetwork:
    """The paper's network, bound to points of a robot's frame."""

    def __init__(
        self,
        weights: Sequence[Float32[ndarray, "_"]],
        sonars: int,
        sonar: Int32[ndarray, "zone points"],
        distance: Float32[ndarray, "zone points"],
        looks: Int32[ndarray, "zone points"],
        place: Float32[ndarray, "hidden points"],
        prior: float,
    ) -> None:
        """A network.

        Args:
            weights: of the first layer those of readings and of what lies beyond, then weights and biases of the
                others.
            sonars: how many the robot has.
            sonar: those that are read for each point; ``sonars``: none.
            distance: from each to the point, m.
            looks: -1 where it looks at the point, else 0.
            place: what the place of the point adds to the first layer.
            prior: probability of points at which none looks.
        """

    def look(self, ranges: Float32[ndarray, "scans sonars"]) -> Float32[ndarray, "scans points"]:
        """Probability of each point from scans (m); where no sonar that fired looks the prior, 4 below it."""

class LocalFusion:
    """Local maps into the global one, by eq. 4 and Bayes' rule."""

    def __init__(
        self,
        prior: float,
        least: float,
        most: float,
        on_log_odds: bool,
        footprint: float,
        beams: Float32[ndarray, "sonars 4"] | None,
        cone: float,
    ) -> None:
        """A rule.

        Args:
            prior: log-odds that each view contains and is to lose.
            least: no view is surer, a probability; ``most`` likewise.
            most: see ``least``.
            on_log_odds: whether eq. 4 takes the mean of log-odds in place of probabilities.
            footprint: radius of the robot, m.
            beams: forward, left, axis and longest range of sonars (m, rad) that end within the local map, if any do.
            cone: cosine of the angle off its axis at which a beam ends.
        """

    def add(
        self,
        told: Float32[ndarray, "scans 576"],
        ranges: Float32[ndarray, "scans sonars"],
        corner: Float32[ndarray, "scans 2"],
        heading: Float64[ndarray, "scans"],
        first: Int32[ndarray, "scans 2"],
        cell: float,
        log_odds: Float32[ndarray, "rows cols"],
        observed: Bool[ndarray, "rows cols"],
        views: Int32[ndarray, "rows cols"],
    ) -> None:
        """Add local maps to a window of the map, in their order; arguments as of ``PolarTables.add``.

        Args:
            told: of the local map's cells; what is not spoken of 4 below its value, on log-odds 100.
            ranges: m; of a sonar that did not fire nan.
            corner: centre of the first cell of each scan's patch, from the robot, world axes, m.
            heading: of the robot, rad.
            first: row and column of that cell in the window.
            cell: side of a cell, m.
            log_odds: written to, as the next two.
            observed: where a scan spoke.
            views: scans that spoke of each cell.
        """
