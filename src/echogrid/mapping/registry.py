"""The sensor models by name: the network and the classical models are peers."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path

from echogrid.errors import UsageError
from echogrid.extras import need
from echogrid.models.model import Model
from echogrid.models.networks.paper_network import FORMAT, Network
from echogrid.models.networks.set_network import FORMAT as SET_FORMAT
from echogrid.models.networks.set_network import SetNetwork
from echogrid.models.networks.weights import read_weights
from echogrid.yaml_keys import shown

_WEIGHTS = resources.files("echogrid") / "weights"


def _set_network() -> SetNetwork:
    return replace(SetNetwork.load(str(_WEIGHTS / "set.npz")), name="set-network")


def _network() -> Network:
    return replace(Network.load(str(_WEIGHTS / "any.npz")), name="network")


# What follows takes long to import, and comes when it is asked for.


def _log_odds(name: str) -> Model:
    need("interpreter", "train")
    from echogrid.models.classical import log_odds

    return getattr(log_odds, name)()


def _calculus(name: str) -> Model:
    need("interpreter", "train")
    from echogrid.models.classical import calculi

    return getattr(calculi, name)()


def _forward_model() -> Model:
    from echogrid.models.classical.forward_model import ForwardModel

    return ForwardModel()


MODELS: dict[str, Callable[[], Model]] = {
    "set-network": _set_network,
    "network": _network,
    "cone": partial(_log_odds, "Cone"),
    "cone-no-echo": partial(_log_odds, "ConeNoEcho"),
    "moravec-elfes": partial(_calculus, "MoravecElfes"),
    "elfes": partial(_log_odds, "Elfes"),
    "nav2": partial(_log_odds, "Nav2"),
    "nav2-clearing": partial(_log_odds, "Nav2Clearing"),
    "nav2-tuned": partial(_log_odds, "Nav2Tuned"),
    "himm": partial(_calculus, "Himm"),
    "muriel": partial(_log_odds, "Muriel"),
    "dempster-shafer": partial(_calculus, "DempsterShafer"),
    "fuzzy": partial(_calculus, "Fuzzy"),
    "lim-cho": partial(_log_odds, "LimCho"),
    "em": _forward_model,
}
"""Models by name, the default first; the networks have the weights that ship with the package."""

DEFAULT = "set-network"


def sensor_model(name_or_weights: str | Path) -> Model:
    """A model by name, or a network with weights from a file.

    Raises:
        InputError: the file is not a weights file.
        UsageError: neither a name nor a file; or JAX is not installed, which the classical models but ``em`` need.
    """
    if not isinstance(name_or_weights, str | Path):
        raise UsageError(f"interpreter: found {shown(name_or_weights)}, expected a model or its name")
    name_or_weights = str(name_or_weights)
    if name_or_weights in MODELS:
        return MODELS[name_or_weights]()
    if not Path(name_or_weights).exists():
        raise UsageError(f"interpreter: found {name_or_weights}, expected {', '.join(MODELS)} or a weights file")
    kinds = {SET_FORMAT: SetNetwork, FORMAT: Network}
    return kinds[str(read_weights(name_or_weights, *kinds)["format"])].load(name_or_weights)
