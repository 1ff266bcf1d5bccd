"""Commands that make maps of logs and score them: map, score."""

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from jaxtyping import Float
from numpy import ndarray
from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.cli.arguments import Ros, check_map, drop, open_log, open_map, print_notes, robot_arg, shown
from echogrid.cli.poses import POSE_FILES, corrected, pose_files, pose_settings, report, write_poses
from echogrid.errors import escaped
from echogrid.files import made, printable, replacing
from echogrid.frame import Frame, Log
from echogrid.grid import Grid
from echogrid.mapping.intake import Heard
from echogrid.output.folder import check_folder
from echogrid.output.follower import Follower
from echogrid.robot import Robot, robot_yaml
from echogrid.track import Track

if TYPE_CHECKING:
    from echogrid.models.model import Model
    from echogrid.position.corrected import Corrected


_COVERED = 0.1
"""The map of a drive covers more than this of its truth."""


class _Mapped(NamedTuple):
    """What a log has become."""

    grid: Grid
    path: Float[ndarray, "poses 2"]
    """The drive: x, y, m, world."""
    frames: int
    seconds: float


@dataclass(frozen=True)
class Map:
    """Map a log: sonar ranges and poses in, an occupancy map out.

    Writes map.png (to look at), map.pgm + map.yaml (for ROS map_server), map.npz (log-odds) and run.yaml
    (what was done). Without LOG it maps the sample that ships with echogrid, a simulated drive of a B21.
    """

    log: Annotated[Positional[str | None], arg(metavar="[LOG]")] = None
    """CSV or CARMEN log, or a bag of ROS 1 or ROS 2 (.bag, .mcap, .db3 or a folder)."""
    robot: Annotated[
        str | None, robot_arg(". Default: the robot that the log describes, else b21 if the log has 24 sonars")
    ] = None
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)
    slam: bool = False
    """The poses of the log are odometry that drifts: find the true ones first, from ranges and odometry. Also writes
    trajectory.tum (as found), odometry.tum (as the log says) and graph.g2o. For 4 rangers or more. Of bags it takes
    the poses in odom, where there is such a frame."""
    out: Path = Path("out")
    """Folder for the map."""
    resolution: Annotated[float | None, arg(metavar="M")] = None
    """Side of a cell of the map, m. Default: 0.04 for the set network, else 0.12."""
    interpreter: str = "set-network"
    """set-network, network (the paper's), a weights file, or a classical model: cone, cone-no-echo, moravec-elfes,
    elfes, nav2, nav2-clearing, nav2-tuned, himm, muriel, dempster-shafer, fuzzy, lim-cho, em."""
    half_life: Annotated[float | None, arg(metavar="S")] = None
    """For places that change: time in which what was seen comes to count half, s. Default: it never fades."""
    refine: bool = False
    """Clean the finished map with a 3x3 neighbourhood mask."""
    pgm: Literal["trinary", "scale", "raw"] = "trinary"
    """What map.pgm holds: for navigation trinary; scale and raw hold probabilities, in which Nav2 as it comes finds
    no walls (docs/formats.md says what to set)."""
    view: bool = False
    """Write map.html as well: the map and the drive to explore in a browser."""
    mcap: bool = False
    """Also write map.mcap: poses, ranges and the map as it grew as messages of ROS 2, for Foxglove and rosbags."""
    rerun: bool = False
    """Also write map.rrd and show it in the browser by Rerun (the extra viewer): the drive in time, the
    cones, the map round the robot and the whole map. Served on 127.0.0.1 alone, until Ctrl-C."""

    def run(self) -> None:
        """Map the log and write the folder."""
        from echogrid.mapping.registry import sensor_model
        from echogrid.output.map_file import write_map

        check_map(self.resolution, self.half_life)
        log, robot, named = open_log(self.log, self.robot, self.ros.choice(odometry=self.slam))
        model = sensor_model(self.interpreter)
        title = escaped(f"{Path(log.name).name}, {robot.name}, {model.name}")
        with made(self.out), ExitStack() as stack:  # a folder that cannot be made is found now, not after the mapping
            check_folder(self.out, [*self._besides(), *(POSE_FILES if self.slam else ())])
            begin = time.perf_counter()
            drive = corrected(log, robot) if self.slam else None
            finding = time.perf_counter() - begin
            log = drive.log if drive else log
            followers = list(self._followers(robot, title, drive, stack))
            mapped = self._mapped(log, robot, model, followers)
            settings = self._settings(log, robot, model, mapped, drive)
            # Beside each other both paths are drawn as closely as they are known.
            path, told = (drive.poses, drive.odometry) if drive else (mapped.path, None)
            write_map(self.out, mapped.grid, path, settings, title, self.pgm, told)
            for follower in followers:
                follower.finish(mapped.grid)
            if drive:
                write_poses(self.out, drive)
        drop(self.out, [*self._besides(), *(pose_files(drive) if drive else ())], log.name)
        self._report(log, robot, named, mapped, f", {finding:.1f} s for its poses" if drive else "")
        if drive:
            report(self.out, drive)
        if self.rerun:
            self._show()

    def _mapped(self, log: Log, robot: Robot, model: "Model", followers: list[Follower]) -> _Mapped:
        """Map the log, and show the followers its frames and the map on the way."""
        from echogrid.mapping.build import build_map

        path, heard, grid = Track(), Heard(), None

        def frames() -> Iterator[Frame]:
            for frame in heard.of(shown(log, "mapping")):
                path.add(float(frame.pose[0]), float(frame.pose[1]))
                for follower in followers:
                    follower.add(frame)
                yield frame

        begin = time.perf_counter()
        for grid in build_map(replace(log, open=frames, judges=True), robot, model, self.resolution, self.half_life):
            for follower in followers:
                follower.keep(grid)
        heard.check(log.name)
        assert grid is not None  # of the first frame at least
        seconds = time.perf_counter() - begin
        return _Mapped(grid.refined() if self.refine else grid, path.points(), heard.frames, seconds)

    def _settings(
        self, log: Log, robot: Robot, model: "Model", mapped: _Mapped, drive: "Corrected | None"
    ) -> dict[str, Any]:
        """What run.yaml holds: what is needed to repeat the run."""
        settings = asdict(self) | {"log": log.name, "robot": robot_yaml(robot), "frames": mapped.frames}
        settings |= {"resolution": mapped.grid.resolution, "notes": dict(log.notes)}
        return settings | (pose_settings(drive) if drive else {}) | model.told()

    def _report(self, log: Log, robot: Robot, named: bool, mapped: _Mapped, besides: str) -> None:
        if not named:
            print(f"robot: {robot.name}, as none was named", file=sys.stderr)
        print_notes(log)
        part = mapped.grid.observed_part() or mapped.grid  # as the page counts, and as the picture shows
        (rows, cols), cell = part.shape, part.resolution
        files = f"{self.out}/map.png{', map.html' if self.view else ''}; {self.out}/map.yaml is for Nav2's map_server"
        what = f"{log.name}: {mapped.frames} scans of {robot.name} in {mapped.seconds:.1f} s{besides}"
        print(escaped(f"{what}; map of {cols * cell:.1f} x {rows * cell:.1f} m in {files}"))

    def _besides(self) -> list[str]:
        """The files that the options ask for beside the map."""
        asked = {"map.html": self.view, "map.mcap": self.mcap, "map.rrd": self.rerun}
        return [name for name, wanted in asked.items() if wanted]

    def _followers(self, robot: Robot, title: str, drive: "Corrected | None", stack: ExitStack) -> Iterator[Follower]:
        """What the options ask for beside the map; their files are whole when the stack is closed."""
        if self.view:
            from echogrid.output.page import Page

            page = stack.enter_context(replacing(self.out / "map.html"))
            yield Page(page, robot, title, drive.loops if drive else None)
        if self.mcap:
            from echogrid.output.mcap_file import Recorder

            yield stack.enter_context(Recorder(self.out / "map.mcap", robot))
        if self.rerun:
            from echogrid.output.rerun_file import Viewing

            yield stack.enter_context(Viewing(self.out / "map.rrd", robot))

    def _show(self) -> None:
        """Show map.rrd until Ctrl-C."""
        from echogrid.output.rerun_server import served

        with suppress(KeyboardInterrupt), served(self.out / "map.rrd") as shown:
            print(f"{self.out}/map.rrd is at {shown.address} until Ctrl-C", flush=True)
            shown.wait()


@dataclass(frozen=True)
class Score:
    """Score a map against a truth grid.

    found, wiped: surface cells that the map shows, or shows as free; free: free cells shown free; false: free
    cells shown occupied; auc, nll, brier, ece: how well the probabilities tell surface from free.
    """

    map: Annotated[Positional[Path], arg(metavar="MAP")]
    """Map folder, map.npz or map_server map.yaml."""
    truth: Annotated[Positional[Path], arg(metavar="TRUTH")]
    """Truth grid (.npz)."""

    def run(self) -> None:
        """Print the scores."""
        from echogrid.metrics import check_overlap, score
        from echogrid.output.map_file import read_truth

        grid, truth = open_map(self.map), read_truth(self.truth)
        share = check_overlap(grid, truth, printable(self.map), printable(self.truth))
        if share < _COVERED:
            found = f"the map speaks of {share:.1%} of the truth's cells alone"
            print(f"note: {found}: is it the truth of this drive, in the same frame?", file=sys.stderr)
        for name, value in asdict(score(grid, truth)).items():
            print(f"{name:13} {value}" if isinstance(value, int) else f"{name:13} {value:.4f}")
