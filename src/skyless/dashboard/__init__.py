"""The live page: what it shows, and the server that it talks to.

Public: app, guard, live, overlays, playback, serve.
Within the package: overlay_process, polygon, state, zones.
"""
