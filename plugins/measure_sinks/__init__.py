"""Sinks: poses as they come, to OpenIGTLink, LSL, Foxglove and Zenoh (ROS 2)."""
