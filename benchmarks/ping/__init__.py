"""A bare ping-pong between two processes: what the middleware alone costs."""
