"""What nodes share: the one table of topics, messages, settings, and the ROS helpers."""
