"""The protocol machines of anchors of protocol 2, and the choice of the machine for a site.

Public: authentication, factory, slots. Within the package: free, neighbours.
"""
