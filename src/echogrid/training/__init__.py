"""Weights from nothing: simulated drives to learn from, and back-propagation."""

from echogrid.extras import need

need("train", "train")
