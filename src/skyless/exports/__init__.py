"""Recordings of a running site in the formats of other programs.

Public: rosbag.
"""
