"""The emulated radio world: oscillators, channel, ether and moving tags, deterministic by seed."""
