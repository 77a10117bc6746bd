"""The IMU: its bytes, its clock, how it is mounted. No ROS."""
