"""Positions from anchors without a common time: their packets, or time differences made of them.

Public: anchor_errors, difference_tracking, packet_tracking, pair_engine.
"""
