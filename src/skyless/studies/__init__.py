"""Errors of the receiver over many simulated runs, one module for each study; ``common/`` is what studies share.

Public: catalogue, episodes, run.
Within the package: efficiency, integrity, loss, motion, nlos, room, scale, sitetime, survey_room, sync, watch.
"""
