"""What the nodes share of ROS: event loop, endpoints, introspection, parameters."""
