"""The plant: equations, time stepping, and the node that publishes its state."""
