"""Speed and memory of mapping bags on one core: a drive of a ring of 24 sonars with tf at 5 Hz, in the three formats.

Targets: 80,000 messages/s decoded and mapped; a bag of 1 GB in less than 500 MB of memory, whether camera images or
ranges fill it. Each run is a process of its own on one core. The large bags are of 1 GB with camera images, and of
0.1 GB with nothing but ranges, for those take long to write: `--images GB` and `--ranges GB` set other lengths (0:
none). All lie in `--folder`, and are removed.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib import resources
from itertools import count
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from echogrid import Robot, load_log

RANGE, TF, IMAGE = "sensor_msgs/msg/Range", "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/Image"
RATE_HZ, START_S, IMAGE_BYTES = 5.0, 1_600_000_000.0, 640 * 480 * 3

RUN = """
import json, os, sys, time
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from echogrid import build_map, load_log
def run():
    log = load_log(sys.argv[1])
    frames = 0
    def counted():
        nonlocal frames
        for frame in log:
            frames += 1
            yield frame
    begin = time.perf_counter(), time.process_time()
    if sys.argv[2] == "map":
        steps = build_map(counted(), log.robot, resolution=float(sys.argv[3]))
        next(steps)  # start-up
        first, begin = frames, (time.perf_counter(), time.process_time())
        for step in steps: pass
    else:
        first = 0
        for frame in counted(): pass
    spent = time.perf_counter() - begin[0], time.process_time() - begin[1]
    # Not ru_maxrss, in which the process that started this one counts in.
    with open("/proc/self/status") as status:
        peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    print(json.dumps([frames - first, *spent, peak / 1024]))
run()
"""


class Drive:
    """The messages of the shipped drive, again and again, ready to be written."""

    def __init__(self, form: str):
        ros1 = form == "bag"
        self.ros1, self.store = ros1, get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        robot = Robot.load("b21")
        frames = load_log(str(resources.files("echogrid") / "data" / "sample.csv"), robot)
        self.robot, self.frames = robot, list(frames)
        # A Range is written by putting its stamp and range into the bytes of one.
        self._ranges = [bytearray(self._raw(RANGE, self._range(f"sonar_{i}"))) for i in range(robot.sonars)]

    def _raw(self, kind, message):
        return (self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, kind)

    def _header(self, stamp, frame):
        types = self.store.types
        ns = round(stamp * 1e9)
        time = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return types["std_msgs/msg/Header"](**({"seq": 0} if self.ros1 else {}), stamp=time, frame_id=frame)

    def _range(self, frame):
        robot = self.robot
        return self.store.types[RANGE](
            header=self._header(0, frame),
            radiation_type=0,
            field_of_view=robot.beam_width_rad,
            min_range=robot.min_range_m,
            max_range=robot.max_range_m,
            range=0.0,
        )

    def transforms(self, stamp, parent, places):
        """A TFMessage with the places of some frames, as it is sent."""
        types = self.store.types
        each = [
            types["geometry_msgs/msg/TransformStamped"](
                header=self._header(stamp, parent),
                child_frame_id=child,
                transform=types["geometry_msgs/msg/Transform"](
                    translation=types["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=0.0),
                    rotation=types["geometry_msgs/msg/Quaternion"](
                        x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2))
                    ),
                ),
            )
            for child, (x, y, yaw) in places
        ]
        return self._raw(TF, types[TF](transforms=each))

    def messages(self) -> Iterator[tuple[str, str, int, bytes]]:
        """Topic, type, time of recording (ns) and bytes, without end."""
        mounts = [(f"sonar_{i}", mount) for i, mount in enumerate(self.robot.mounts)]
        yield "/tf_static", TF, round(START_S * 1e9), self.transforms(START_S, "base_link", mounts)
        stamp_at = 4
        for number in count():
            frame = self.frames[number % len(self.frames)]
            stamp = START_S + number / RATE_HZ
            ns = round(stamp * 1e9)
            yield "/tf", TF, ns, self.transforms(stamp, "odom", [("base_link", frame.pose)])
            head = np.array([ns // 10**9, ns % 10**9], "<u4").tobytes()
            for i, value in enumerate(frame.ranges.astype("<f4")):
                data = self._ranges[i]
                data[stamp_at : stamp_at + 8] = head
                data[-4:] = value.tobytes()
                yield f"/sonar/{i}", RANGE, ns, bytes(data)

    def image(self) -> bytes:
        """A camera image, as it is sent."""
        pixels = np.random.default_rng(0).integers(0, 256, IMAGE_BYTES, np.uint8)
        return self._raw(
            IMAGE,
            self.store.types[IMAGE](
                header=self._header(START_S, "camera"),
                height=480,
                width=640,
                encoding="rgb8",
                is_bigendian=0,
                step=1920,
                data=pixels,
            ),
        )


def write(path: Path, form: str, until_bytes: float, images: bool = False) -> tuple[int, int]:
    """Write a bag of so many bytes of messages; how many messages of sonars and tf, and how many bytes, it has."""
    drive = Drive(form)
    storage = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    image = drive.image() if images else b""
    written = messages = 0
    with BagWriter(path) if drive.ros1 else FolderWriter(path, version=9, storage_plugin=storage) as writer:
        connections = {}

        def put(topic, kind, ns, data):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=drive.store)
            writer.write(connections[topic], ns, data)

        for topic, kind, ns, data in drive.messages():
            put(topic, kind, ns, data)
            messages += 1
            written += len(data) + 40  # with what the formats add to each
            if images and topic == "/tf":
                put("/camera", IMAGE, ns, image)
                written += len(image)
            if written >= until_bytes:
                break
    return messages, sum(file.stat().st_size for file in path.rglob("*")) if path.is_dir() else path.stat().st_size


def measure(path: Path, messages: int, what: str, resolution: float = 0.12) -> str:
    """Read a bag in a process of its own, and say how fast it was and what it took."""
    command = [sys.executable, "-c", RUN, str(path), what, str(resolution)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    frames, wall, cpu, peak = (float(part) for part in done.stdout.strip("[]\n").split(","))
    counted = frames * 25  # 24 ranges and a pose
    assert counted <= messages + 25, "more than there is"
    return f"{counted / wall:8,.0f} messages/s ({counted / cpu:8,.0f} of CPU time), peak {peak:.0f} MB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=float, default=1.0, metavar="GB")
    parser.add_argument("--ranges", type=float, default=0.1, metavar="GB")
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        for form in ("bag", "mcap", "sqlite3"):
            path = folder / ("drive.bag" if form == "bag" else f"drive-{form}")
            messages, size = write(path, form, 25e6)
            print(f"{form}: {messages:,} messages, {size / 1e6:.0f} MB")
            print(f"  read                       {measure(path, messages, 'read')}")
            print(f"  read and map, cells 0.12 m {measure(path, messages, 'map')}")
            print(f"  read and map, cells 0.04 m {measure(path, messages, 'map', 0.04)}", flush=True)
        for form in ("bag", "mcap", "sqlite3"):
            for images, length in ((True, args.images), (False, args.ranges)):
                if length <= 0:
                    continue
                path = folder / ("large.bag" if form == "bag" else f"large-{form}")
                messages, size = write(path, form, length * 1e9, images)
                holds = "camera images and ranges" if images else "ranges"
                told = measure(path, messages, "map")
                print(f"{form} of {size / 1e9:.2f} GB, {holds}: {messages:,} messages, {told}", flush=True)
                shutil.rmtree(path) if path.is_dir() else path.unlink()


if __name__ == "__main__":
    main()
