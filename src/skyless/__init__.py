"""GPS without a sky: fixed anchors broadcast, tags only listen, and each computes its own position."""
