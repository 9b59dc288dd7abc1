"""Stands in for the tuner in measurements: episodes on demand, timed."""
