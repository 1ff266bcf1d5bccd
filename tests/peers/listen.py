"""Runs in a network namespace: hears a domain of ROS 2 for some seconds, and says as JSON what came.

listen.py DOMAIN INTERFACE SECONDS
"""

import json
import sys
import time

from echogrid.dds import Network
from echogrid.messages import Choice

network = Network(int(sys.argv[1]), sys.argv[2], Choice(), "/map", "/local_map")
print("ready", flush=True)
heard = []
end = time.monotonic() + float(sys.argv[3])
while time.monotonic() < end:
    network.wait(0.05)
    network.discover()
    for _, topic, message in network.take():
        value = getattr(message, "range", None)
        heard.append([topic, type(message).__name__, value if value == value else None])
print(json.dumps({"kept": network.kept, "heard": heard, "refused": network.refused}))
