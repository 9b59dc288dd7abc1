"""The web outlet of the views: a page and its server, on this machine only."""
