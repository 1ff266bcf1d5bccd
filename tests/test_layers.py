import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import echogrid

PACKAGE = Path(echogrid.__file__).parent

# The rooms along the way of the data. A room imports only from rooms before it, a module only from modules before it.
PLAN = {
    "": "errors extras _core geometry temporary files packed npz yaml_keys limits robot stillness doubts frame track "
    "grid metrics",
    "simulation": "regions targets world beam_patterns acoustics rooms drive scene echo simulate vehicle",
    "ros": "rigid transforms sonars gathering messages",
    "bags": "recognising unpacking ros1_stream message_types bag_file events topics clocks survey units floor mounts "
    "reading_plan reader",
    "logs": "lines rows csv_header csv_log carmen formats contents",
    "models": "batches model",
    "models.classical": "beam sweep log_odds calculi forward_model",
    "models.networks": "weights memory set_layers set_encoder surroundings set_core set_network local_map "
    "paper_network paper_layers",
    "mapping": "registry intake mapper build",
    "position": "motion graph matching echoes walls pieces bends contradictions drive slam forgetting growing beside "
    "online remapping odometry corrected particles beams sights usual floor localiser hypotheses localise",
    "calibration": "readings walls places beams health variants swaps calibrate findings",
    "planning": "clearance paths following frontiers asides choice body patience explorer guiding onward nearby "
    "placing explore",
    "training": "drives gradient_descent paper_examples paper_training set_lessons map_lessons map_training "
    "set_training",
    "output": "trajectory graph_file folder follower map_picture scan_picture map_server_file map_file mcap_file "
    "recording page rerun_file rerun_server calibration_files",
    "fleet": "lattice sums store poses job reading local_cluster engine page changes changes_files",
    "microcontroller": "array constants source",
    "live": "sonar_array clocks senders hearing telling placing known live_map driving session base sockets "
    "participant tf_topics dds_types dds base_topics",
    "cli": "ending arguments network info poses maps localise calibrating planning simulation export driving live "
    "robot fleet stores helping completion commands",
}
ORDER = [f"{room}.{name}".strip(".") for room, names in PLAN.items() for name in [*names.split(), ""] if room or name]


def modules():
    for path in sorted(PACKAGE.rglob("*.py*")):  # of the compiled core its stub
        if path.suffix not in (".py", ".pyi"):
            continue
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").rstrip(".")
        if name:
            yield name, ast.parse(path.read_text(encoding="utf-8"))


TREES = dict(modules())


def imported(tree):
    """The modules of the package that a module imports, on top or in a function."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name.split(".")[0] == "echogrid")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the package"
            if node.module == "echogrid":
                yield from (f"echogrid.{name.name}" for name in node.names if name.name != "__version__")
            elif node.module and node.module.startswith("echogrid."):
                submodules = [f"{node.module}.{name.name}" for name in node.names]
                below = [name for name in submodules if name.removeprefix("echogrid.") in TREES]
                yield from below or [node.module]


def calls(tree):
    return {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}


def test_every_module_has_its_place():
    assert sorted(TREES) == sorted(ORDER)


@pytest.mark.parametrize("name", ORDER)
def test_imports_run_one_way(name):
    below = ORDER[: ORDER.index(name)]
    assert [module for module in imported(TREES[name]) if module.removeprefix("echogrid.") not in below] == []


def test_importing_the_package_imports_none_of_its_modules():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    run = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    assert list(imported(ast.Module(run, []))) == []


@pytest.mark.parametrize("name", [name for name in ORDER if name.split(".")[0] != "cli"])
def test_the_library_neither_prints_nor_exits(name):
    said = calls(TREES[name]) & {"print", "pprint", "sys.stdout.write", "sys.stderr.write"}
    left = calls(TREES[name]) & {"sys.exit", "exit", "quit", "os._exit", "SystemExit"}
    assert not said
    assert not left


def loaded_after(code, *arguments):
    """Names of the top packages that a fresh Python has loaded after some code."""
    code += "\nimport sys; sys.__stdout__.write(' '.join({name.split('.')[0] for name in sys.modules}))"
    command = [sys.executable, "-W", "error", "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_the_package_starts_without_jax():
    assert loaded_after("import echogrid") & {"jax", "numpy", "scipy", "matplotlib"} == set()


def test_the_command_starts_without_jax():
    assert loaded_after("import echogrid.cli.commands") & {"jax", "optax", "scipy", "matplotlib", "rosbags"} == set()


def test_a_log_that_is_no_bag_is_read_and_described_without_what_opens_bags_and_draws(tmp_path):
    log = tmp_path / "drive.csv"
    log.write_text("t,x,y,theta,r0,r1\n0,1,2,0.5,1.5,inf\n0.5,1.25,2,0.5,,2.5\n")
    code = """
import sys
from echogrid import Robot, load_log
from echogrid.logs.contents import describe
assert describe(load_log(sys.argv[1])).frames == 2
assert Robot.load("b21").sonars == 24
"""
    assert loaded_after(code, log) & {"jax", "optax", "scipy", "matplotlib", "rosbags"} == set()


def test_the_set_network_is_exported_without_jax(tmp_path):
    code = "import sys; from echogrid.cli import main; main(['export', '--c', sys.argv[1]])"
    assert loaded_after(code, tmp_path / "firmware") & {"jax", "jaxlib", "optax", "scipy", "matplotlib"} == set()
    assert (tmp_path / "firmware" / "echogrid.c").exists()


def test_every_name_that_the_package_offers_is_there():
    assert sorted(echogrid.__all__) == sorted(echogrid._HOME)
    for name in echogrid.__all__:
        assert getattr(echogrid, name).__module__.startswith("echogrid.")
    with pytest.raises(AttributeError, match="module 'echogrid' has no attribute 'sonar'"):
        echogrid.sonar  # noqa: B018


def test_the_picture_for_contributors_is_the_plan():
    text = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rooms = [line.split("  ")[0].strip() for line in re.findall(r"^ {4}(\S.*)$", text, re.MULTILINE)]
    assert rooms == ["ground floor", *(room for room in PLAN if room and "." not in room)]
