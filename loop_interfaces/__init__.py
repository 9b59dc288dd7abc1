"""What the nodes share: topics, array codec, problem parameters, the nodes' event loop."""
