"""Sensor models: what readings say of cells, and how each kind of model is fused into a map."""
