"""The motor drive: CiA 402 over CANopen. No ROS."""
