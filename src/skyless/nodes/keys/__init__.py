"""Keys of a site in the programs of anchors and tags: their files, what is remembered of them, and lines about faults.

Public: anchor_keys, anchor_report, tag_memory, tag_report. Within the package: faults.
"""
