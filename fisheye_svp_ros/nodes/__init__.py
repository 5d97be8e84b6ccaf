"""The ROS 2 nodes: parameters and messages in, one call into the core, messages out."""
