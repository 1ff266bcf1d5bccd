"""Bags of ROS as files: opened, surveyed, and read into frames."""
