"""What a survey needs, out of recordings: differences of tags at known positions, and tags that were carried around.

``run`` is all of ``skyless calibrate`` on a recording.

Public: run, samples, walk.
"""
