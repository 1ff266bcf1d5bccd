"""Weights from nothing: simulated drives to learn from, and back-propagation."""
