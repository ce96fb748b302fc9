"""Fit of positions to ranges."""
