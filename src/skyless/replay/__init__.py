"""Recordings through the filter again, judged against the truth."""
