"""Compiling kernels before they are needed: in several processes at once, and with counts.

The parts of a computation (``parts``) are compiled by one process each (``worker``); ``processes`` starts these,
collects their counts, and sees to it that only one program compiles at a time.

Public: parts, processes.
"""
