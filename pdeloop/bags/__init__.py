"""Recorded bags: reading, verifying, recovering, identifying from them."""
