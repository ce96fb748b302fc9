"""The emulated radio world: oscillators, channel, medium and moving tags, deterministic by seed.

Public: channel, impairments, listening, medium, oscillator, range_errors, stations, streams, trajectory, world.
"""
