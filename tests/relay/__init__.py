"""A relay that loses, repeats, delays and reorders messages on purpose."""
