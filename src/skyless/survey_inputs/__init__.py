"""What a survey needs, out of recordings: ranges of anchors, tags at known positions, tags that were carried around.

``run`` is all of ``skyless calibrate`` on a recording.

Public: recorded_stamps, report, run, samples, walk.
"""
