"""The narrow radio interface, and the radios behind it.

Public: emulated, ether_wire, interface.
"""
