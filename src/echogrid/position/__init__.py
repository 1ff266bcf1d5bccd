"""Where the robot was, from ranges and odometry that drifts."""
