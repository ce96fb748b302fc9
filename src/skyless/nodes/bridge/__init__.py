"""Where bridges get a site's fixes from: a broker, or the tags of the same process.

Public: broker_bridge, tag_bridge.
"""
