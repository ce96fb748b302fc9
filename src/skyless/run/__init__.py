"""The programs of a site: anchors, tags, broker, recordings, live survey."""
