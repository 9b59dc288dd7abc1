"""The commands of `pdeloop`, one module each: `add` declares the arguments, a handler does it."""
