"""Studies: many episodes each, pure functions that a command or a cluster may call."""
