"""What starts and observes the nodes: command line, supervisor, in-process runner."""
