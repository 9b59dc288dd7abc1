"""Shows a running loop to ROS tools: markers, an image and named numbers, throttled."""
