"""What a survey needs, out of options and recordings: facts, ranges of anchors, and tags.

Public: biases, facts, options, recorded_stamps, tags.
"""
