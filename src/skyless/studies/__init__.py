"""Errors of the receiver over many simulated runs, one module for each study.

Public: catalogue, episodes, plan, runner.
Within the package: efficiency, integrity, loss, motion, nlos, picture, room, scale, sitetime, summary, sync, watch,
worlds.
"""
