"""The emulated radio world: oscillators, channel, medium and moving tags, deterministic by seed.

Public: channel, impairments, listening, medium, oscillator, range_errors, site_time, stations, streams, trajectory,
world.
"""
