"""Reads everything that a viewer publishes, as the tools of people do."""
