"""The sensor models by name: the network and the classical models are peers."""

from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path

from echogrid.beam import ReadingModel
from echogrid.calculi import DempsterShafer, Fuzzy, Himm, MoravecElfes
from echogrid.classical import Cone, ConeNoEcho, Elfes, LimCho, Muriel, Nav2, Nav2Clearing, Nav2Tuned
from echogrid.em import ForwardModel
from echogrid.errors import UsageError
from echogrid.interpret import Interpreter, Network

Model = Interpreter | ReadingModel | ForwardModel


def _shipped() -> Network:
    return replace(Network.load(str(resources.files("echogrid") / "weights" / "any.npz")), name="network")


MODELS: dict[str, Callable[[], Model]] = {
    "network": _shipped,
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
"""Models by name; ``network`` has the weights that ship with the package."""


def sensor_model(name_or_weights: str) -> Model:
    """A model by name, or the network with weights from a file.

    Raises:
        InputError: the file is not a weights file.
        UsageError: neither a name nor a file.
    """
    if name_or_weights in MODELS:
        return MODELS[name_or_weights]()
    if not Path(name_or_weights).exists():
        raise UsageError(f"interpreter: found {name_or_weights}, expected {', '.join(MODELS)} or a weights file")
    return Network.load(name_or_weights)
