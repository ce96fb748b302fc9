"""Fixes live in Foxglove, over its WebSocket protocol.

Public: target.
Within the package, bottom to top: protocol, session.
"""
