"""The study ``survey-room``: tags in a room whose site file a survey has written.

In the order of reading: ``files`` (one room, and the site files that different people would write for it), ``study``
(its tags with each of these files).

Public: study.
"""
