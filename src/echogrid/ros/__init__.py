"""What messages of ROS say, and how single readings and transforms become frames; no ROS is needed."""
