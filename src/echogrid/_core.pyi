"""The compiled core; its sources lie in core/ of the repository.

Arrays of another type than is named are converted, those of whole numbers apart. While a function computes, other
threads of Python run.
"""

from jaxtyping import Float, Float32, Float64, Int64
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
