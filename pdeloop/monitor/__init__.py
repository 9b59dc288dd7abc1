"""The live page: a node that watches a loop, and a web server on this machine that shows it."""
