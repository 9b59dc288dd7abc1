"""Recorded bags: reading, describing, verifying and playing them."""
