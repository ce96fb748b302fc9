"""Notices that an anchor has moved, that its delay has changed, or that a link is blocked.

In the order of reading: ``finding`` (what comes out), ``history`` (what a pair's range usually is, and how it drifts),
``causes`` (what a cause does to the ranges, and the evidence for it), ``explain`` (which causes explain the changes of
a window, and which others would as well), ``monitor`` (two of three windows), ``moved`` (the same while the ranges of
a survey are gathered).

Public: causes, explain, finding, monitor, moved.
"""
