"""The web outlet of the view core: a page and its server, on this machine only."""
