"""What wheels say of a drive: its increments with errors that stay the same a whole run, and with noise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.geometry import wrapped
from echogrid.position.motion import chained, steps


@dataclass(frozen=True)
class Odometry:
    """Sigmas of the errors of dead reckoning."""

    scale: float = 0.01
    """Of the scale of distances, the same for a run."""
    bias_deg_m: float = 1.0
    """Of the heading's drift on each metre of way, the same for a run, degrees/m."""
    noise: float = 0.03
    """Of the distance of a metre, m; the noise of all metres adds up as a random walk."""
    noise_deg_m: float = 1.0
    """Of the heading over a metre of way, degrees; a random walk too."""

    def times(self, factor: float) -> "Odometry":
        """All errors so many times as large."""
        return Odometry(*(factor * sigma for sigma in (self.scale, self.bias_deg_m, self.noise, self.noise_deg_m)))

    def of(self, truth: Float[ndarray, "n 3"], rng: np.random.Generator) -> Float[ndarray, "n 3"]:
        """Poses as dead reckoning has them, the first as it is in truth (m, m, rad).

        The draws are the same whatever the sigmas, so that one run with twice the errors errs the same way.
        """
        scale, bias = self.scale * rng.standard_normal(), self.bias_deg_m * rng.standard_normal()
        step = steps(truth)
        way = np.hypot(step[:, 0], step[:, 1])
        along, turn = rng.standard_normal((2, len(step))) * np.sqrt(way)
        step[:, 0] += scale * way * np.sign(step[:, 0]) + self.noise * along
        step[:, 2] += np.deg2rad(bias * way + self.noise_deg_m * turn)
        return wrapped(chained(truth[0], step))
