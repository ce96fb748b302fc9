"""From stamps of anchors to ranges."""
