"""Whether a stand-in keeps to the interface: `checks` (pure), and `node`, which reaches it."""
