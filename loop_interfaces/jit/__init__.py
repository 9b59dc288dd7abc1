"""Compiled helpers: vector lanes, atomic words, calls by address, the cache."""
