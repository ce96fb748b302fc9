"""Input of a survey from options and recordings: facts, ranges of anchors, and tags."""
