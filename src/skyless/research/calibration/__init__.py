"""What a survey needs, from options and recordings: facts, ranges of anchors, and tags."""
