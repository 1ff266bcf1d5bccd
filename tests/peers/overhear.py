"""Runs in a network namespace: hears a robot and who drives it until its stdin ends, and says as JSON what came.

overhear.py DOMAIN
"""

import json
import sys
import time
from threading import Thread

from cyclonedds.core import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from echogrid.live.dds_types import Clock, OccupancyGrid, Odometry, PoseStamped, RangeWithVariance, TFMessage, Twist
from echogrid.live.participant import joined

KINDS = {
    "/cmd_vel": Twist,
    "/odom": Odometry,
    "/clock": Clock,
    "/map": OccupancyGrid,
    "/goal_pose": PoseStamped,
    "/tf_static": TFMessage,
    "/sonar/s3": RangeWithVariance,
}
QOS = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(1000))
LATE = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(10))


def seconds(stamp):
    return stamp.sec + stamp.nanosec * 1e-9


def told(topic, sample):
    """What is kept of a message."""
    if topic == "/cmd_vel":
        return sample.linear.x, sample.angular.z
    if topic == "/odom":
        pose = sample.pose.pose
        place = pose.position.x, pose.position.y
        return seconds(sample.header.stamp), *place, sample.header.frame_id, sample.child_frame_id
    if topic == "/clock":
        return seconds(sample.clock)
    if topic == "/map":
        return sample.header.frame_id, sample.info.width * sample.info.height
    if topic == "/goal_pose":
        return sample.header.frame_id, sample.pose.position.x, sample.pose.position.y
    if topic == "/tf_static":
        return [(each.header.frame_id, each.child_frame_id) for each in sample.transforms]
    return seconds(sample.header.stamp), sample.header.frame_id, sample.field_of_view


link = joined(int(sys.argv[1]), "lo")
readers = {
    topic: DataReader(link.participant, Topic(link.participant, f"rt{topic}", kind), LATE if "tf" in topic else QOS)
    for topic, kind in KINDS.items()
}
heard = {topic: [] for topic in KINDS}
waiting = Thread(target=sys.stdin.read)
waiting.start()
print("ready", flush=True)
while waiting.is_alive():
    time.sleep(0.02)
    for topic, reader in readers.items():
        for sample in reader.take(1000):
            if sample.sample_info.valid_data:
                heard[topic].append((time.monotonic(), told(topic, sample)))
print(json.dumps(heard))
