"""MAVLink, for autopilots: positions of a tag as ArduPilot, PX4 and GPS drivers accept them.

Frames, messages in them, messages of a fix, and what is sent when.

Within the package: encoder, frames, messages, profiles.
"""
