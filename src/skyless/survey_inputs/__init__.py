"""What a survey needs, out of recordings.

Public: recorded_stamps.
"""
