"""Measuring programs: `pdeloop bench`."""
