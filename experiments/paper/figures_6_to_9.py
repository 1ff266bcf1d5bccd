"""Figures 6 to 9: rooms and corridors of different walls, mapped with the same weights and settings.

    python -m experiments.paper.figures_6_to_9

Plant 2 is the world `plant` with smooth walls, Plant 3 the same with rough ones; corridor 1 (one painted wall, one
of tiles) and corridor 2 (wood) are the worlds `corridor` and `corridor-wood`. The plans of the paper are lost: these
are our own. A B21 and a Robuter II drive through each; there is a figure with both robots' maps for each place. The
maps of Plant 2 and 3 are also shown before and after the neighbourhood mask of the paper's earlier system, and by
every classical model beside the network.
"""

from dataclasses import asdict

from echogrid import Robot, World
from echogrid.metrics import score
from echogrid.simulation.drive import tour, truth_of
from echogrid.simulation.simulate import Simulator
from experiments.common.maps import EVERY, mapped
from experiments.common.report import page, record, rounded

SEED, RESOLUTION = 5, 0.12
ROBOTS = {"b21": "B21", "robuter2": "Robuter II"}
PLACES = {
    "figure_6": ("plant", "smooth", "Plant 2: smooth walls"),
    "figure_7": ("plant", "rough", "Plant 3: rough walls"),
    "figure_8": ("corridor", "as-given", "Corridor 1: a painted wall and one of tiles"),
    "figure_9": ("corridor-wood", "as-given", "Corridor 2: wooden walls"),
}


def drive(place, robot_name):
    """World, robot, poses and frames of a drive."""
    world_name, walls, _ = PLACES[place]
    world, robot = World.load(world_name).with_walls(walls), Robot.load(robot_name)
    poses = tour(world, robot.footprint_radius_m + 0.1)
    return world, robot, poses, list(Simulator(world, robot).frames(poses, SEED))


def scores(grid, truth):
    """What a record holds of a map."""
    return rounded(asdict(score(grid, truth)))


def main():
    measured = {}
    refinement = []
    for place, (_, _, title) in PLACES.items():
        panels = []
        for robot_name, label in ROBOTS.items():
            world, robot, poses, frames = drive(place, robot_name)
            low, high = world.bounds()
            aspect = (high[1] - low[1] + 1.2) / (high[0] - low[0] + 1.2)
            grid, truth = mapped("network", frames, robot, RESOLUTION), truth_of(world, poses)
            measured[f"{place} {robot_name}"] = scores(grid, truth)
            panels.append((f"{label}, {len(frames)} scans", grid, poses, world))
            if place in ("figure_6", "figure_7"):
                measured[f"{place} {robot_name} refined"] = scores(grid.refined(), truth)
            if robot_name == "b21" and place in ("figure_6", "figure_7"):
                refinement += [
                    (f"{title}, as fused", grid, poses, world),
                    (f"{title}, refined", grid.refined(), poses, world),
                ]
                others = [(name, mapped(name, frames, robot, RESOLUTION), poses, world) for name in EVERY]
                page(others, 4, 2.9, aspect, f"{title}: the same B21 drive, every model", f"models_{place[-1]}")
        page(panels, 2, 4.8, aspect, f"{title}; same weights and settings throughout", place)
    page(refinement, 2, 4.8, 0.86, "The neighbourhood mask of the earlier system (B21)", "refinement")
    record("figures_6_to_9", measured)


if __name__ == "__main__":
    main()
