"""Runs in a network namespace: hears a domain of ROS 2 until its stdin ends, and says as JSON what came.

listen.py DOMAIN INTERFACE
"""

import json
import sys
from threading import Thread

from echogrid.live.dds import Network
from echogrid.ros.messages import Choice

network = Network(int(sys.argv[1]), sys.argv[2], Choice(), "/map", "/local_map")
print("ready", flush=True)
heard, senders = [], set()
waiting = Thread(target=sys.stdin.read)
waiting.start()
last = False
while not last:
    last = not waiting.is_alive()  # and what came before it is still taken
    network.wait(0.05)
    network.discover()
    for _, topic, message, source in network.take():
        value = getattr(message, "range", None)
        heard.append([topic, type(message).__name__, value if value == value else None])
        senders.add((topic, source))
told = {"kept": network.kept, "heard": heard, "senders": len(senders), "refused": network.refused}
print(json.dumps(told | {"sources": len({source for _, source in senders})}))
