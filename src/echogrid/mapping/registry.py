"""The sensor models by name: the network and the classical models are peers."""

from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path

from echogrid.errors import UsageError
from echogrid.models.classical.calculi import DempsterShafer, Fuzzy, Himm, MoravecElfes
from echogrid.models.classical.forward_model import ForwardModel
from echogrid.models.classical.log_odds import Cone, ConeNoEcho, Elfes, LimCho, Muriel, Nav2, Nav2Clearing, Nav2Tuned
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


MODELS: dict[str, Callable[[], Model]] = {
    "set-network": _set_network,
    "network": _network,
    "cone": Cone,
    "cone-no-echo": ConeNoEcho,
    "moravec-elfes": MoravecElfes,
    "elfes": Elfes,
    "nav2": Nav2,
    "nav2-clearing": Nav2Clearing,
    "nav2-tuned": Nav2Tuned,
    "himm": Himm,
    "muriel": Muriel,
    "dempster-shafer": DempsterShafer,
    "fuzzy": Fuzzy,
    "lim-cho": LimCho,
    "em": ForwardModel,
}
"""Models by name, the default first; the networks have the weights that ship with the package."""

DEFAULT = "set-network"


def sensor_model(name_or_weights: str | Path) -> Model:
    """A model by name, or a network with weights from a file.

    Raises:
        InputError: the file is not a weights file.
        UsageError: neither a name nor a file.
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
