"""Recordings of a running site, in MCAP."""
