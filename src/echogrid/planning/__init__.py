"""Where a robot can drive by a map: what is in the way, paths, places that are worth a look, exploration."""
