"""Clocks: the paper's model and two-message synchronisation, and the two-state clock filter.

Public: broadcast, filter, site_clock, two_way, watch.
"""
