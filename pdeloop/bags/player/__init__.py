"""A node that publishes what a bag holds."""
