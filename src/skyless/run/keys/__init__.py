"""Keys of anchors and tags on disk."""
