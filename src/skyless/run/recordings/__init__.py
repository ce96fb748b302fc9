"""Own recordings in MCAP."""
