"""Positions from anchors without a common time: their packets, or time differences made of them."""
