"""What a log says of the robot that drove: its beam, its mounts, its sonars' health, and which order they have."""
