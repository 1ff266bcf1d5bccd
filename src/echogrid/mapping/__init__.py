"""From frames to the map: the loop over a log, and the map that grows scan by scan."""
