"""Writes bags of ROS 1 with Debian's rosbag; run by Debian's Python, which has the packages.

Reads {"messages": [[topic, ns, type, content]], "bags": {path: options}} as JSON from standard input; ``--check``
only says by its exit status whether all packages are there. tests/bag_writers.py says what the messages look like.
"""

import json
import sys

import rosbag
from genpy import Time
from genpy.message import fill_message_args
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud, PointCloud2, Range
from tf2_msgs.msg import TFMessage

TYPES = {
    "sensor_msgs/msg/Range": Range,
    "sensor_msgs/msg/PointCloud": PointCloud,
    "sensor_msgs/msg/PointCloud2": PointCloud2,
    "nav_msgs/msg/Odometry": Odometry,
    "tf2_msgs/msg/TFMessage": TFMessage,
}


def of_ros1(content):
    """The content of a message under ROS 1's names for the parts of a stamp."""
    if isinstance(content, list):
        return [of_ros1(each) for each in content]
    if not isinstance(content, dict):
        return content
    return {
        name: {"secs": value["sec"], "nsecs": value["nanosec"]} if name == "stamp" else of_ros1(value)
        for name, value in content.items()
    }


def message(kind, content):
    said = TYPES[kind]()
    fill_message_args(said, [of_ros1(content)])
    return said


def main():
    if "--check" in sys.argv:
        return
    job = json.load(sys.stdin)
    said = [(topic, message(kind, content), ns) for topic, ns, kind, content in job["messages"]]
    for path, options in job["bags"].items():
        unindexed = options.pop("unindexed", False)
        bag = rosbag.Bag(path, "w", **options)
        for topic, content, ns in said:
            bag.write(topic, content, Time(ns // 10**9, ns % 10**9))
        if unindexed:
            bag.flush()
            bag._file.close()  # as if the recorder had been killed: the index at the end is never written
        else:
            bag.close()


main()
