"""The positioning methods for a tag of a Skyless site, and what beacons become for them.

Public: factory, joint, locate, observations, selection, snapshots.
Within the package: acquisition.
"""
