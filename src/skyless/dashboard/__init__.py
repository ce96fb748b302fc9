"""The live page: what it shows, and the server that it talks to.

Public: app, guard, live, overlays, playback, processors, serve, sites.
Within the package: geojson, overlay_process, state, zone_events.
"""
