"""What Foxglove and other viewers show of a site, as JSON: in recordings, and live.

Public: messages, schemas.
"""
