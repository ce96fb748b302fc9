"""Recordings of a running site, in MCAP.

Public: checkpoint, reception_log, recorder, recording.
Within the package: channels, foxglove.
"""
