"""The compiled path from a received message to the published answer."""
