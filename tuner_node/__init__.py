"""The tuner: optimisers, the training state machine, and the node that runs episodes."""
