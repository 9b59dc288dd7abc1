"""Measuring programs: `python -m benchmarks`."""
