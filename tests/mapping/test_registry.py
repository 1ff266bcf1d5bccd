import json
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path

import pytest

from echogrid.errors import UsageError
from echogrid.mapping.registry import MODELS, sensor_model
from echogrid.models.classical.log_odds import Cone, Nav2, Nav2Clearing
from echogrid.models.networks.paper_network import Network

TUNED = json.loads((Path(__file__).parents[2] / "docs" / "paper" / "tune.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", MODELS)
def test_a_model_goes_by_its_name(name):
    assert sensor_model(name).name == name


def test_the_cone_is_there_with_and_without_its_missing_echoes():
    cone, using = sensor_model("cone"), sensor_model("cone-no-echo")
    assert isinstance(cone, Cone)
    assert isinstance(using, Cone)
    assert (cone.no_echo, using.no_echo) == (False, True)


@pytest.mark.parametrize("name", [name for name in TUNED if name != "nav2"])
def test_the_defaults_are_what_the_recorded_search_chose(name):
    model = sensor_model(name)
    assert {key: getattr(model, key) for key in TUNED[name]["setting"]} == TUNED[name]["setting"]


def test_nav2_is_as_shipped():
    assert (sensor_model("nav2"), sensor_model("nav2-clearing")) == (
        Nav2(phi_m=1.2, no_echo=False),
        Nav2Clearing(phi_m=1.2, no_echo=True, name="nav2-clearing"),
    )


def test_nav2_tuned_is_nav2_but_for_the_number_of_the_search():
    tuned, shipped = sensor_model("nav2-tuned"), sensor_model("nav2")
    assert isinstance(tuned, Nav2)
    assert isinstance(shipped, Nav2)
    assert asdict(tuned) == asdict(shipped) | {"name": "nav2-tuned", "phi_m": tuned.phi_m}
    assert tuned.phi_m < shipped.phi_m


@pytest.mark.parametrize("name", [name for name in MODELS if "network" not in name])
def test_a_model_is_a_class_whose_defaults_are_plain_numbers(name):
    model = type(MODELS[name]())
    assert is_dataclass(model)
    assert all(type(field.default) in (bool, float, str) for field in fields(model))


def test_weights_go_by_their_file(tmp_path):
    shipped = sensor_model("network")
    assert isinstance(shipped, Network)
    shipped.save(tmp_path / "mine.npz")
    assert sensor_model(str(tmp_path / "mine.npz")).name == "mine"


def test_what_is_neither_a_name_nor_a_file_is_one_line():
    with pytest.raises(
        UsageError, match=r"^interpreter: found oracle, expected set-network, network, cone, .*em or a weights file$"
    ):
        sensor_model("oracle")
