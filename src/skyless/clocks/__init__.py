"""Clocks: the paper's model and two-message synchronisation, and the two-state clock filter.

Public: broadcast, composed_time, composition, filter, site_clock, two_way, watch.
"""
