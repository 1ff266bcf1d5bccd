"""Packages that only parts of echogrid need, and that ``pip install echogrid`` leaves out."""

from importlib.util import find_spec

from echogrid.errors import MissingError

EXTRAS = {
    "train": {"JAX": "jax", "optax": "optax"},
    "ros2": {"cyclonedds": "cyclonedds"},
    "fleet": {"dask.distributed": "distributed", "zarr": "zarr"},
    "viewer": {"rerun": "rerun", "its viewer": "rerun_cli"},
}
"""What each extra brings: by what it is called, the module."""


def need(where: str, extra: str) -> None:
    """Make sure that an extra is installed, before anything is done that needs it; nothing is imported.

    Args:
        where: what needs it, as the line begins.
        extra: its name.

    Raises:
        MissingError: it is not.
    """
    for name, module in EXTRAS[extra].items():
        if find_spec(module) is None:
            raise MissingError(f"{where}: found no {name}, expected it: pip install 'echogrid[{extra}]'")
