"""The set network as C for a microcontroller: one robot's scans in, a window of the map round it out."""
