"""The emulated radio world: oscillators, channel, medium and moving tags, deterministic by seed."""
