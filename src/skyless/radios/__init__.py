"""The narrow radio interface, and the radios behind it."""
