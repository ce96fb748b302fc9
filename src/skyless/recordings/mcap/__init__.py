"""Recordings of a running site, in MCAP.

Public: checkpoint, host_clock, reception_log, recorder, recording.
Within the package: channels.
"""
