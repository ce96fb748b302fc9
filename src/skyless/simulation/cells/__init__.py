"""Sites of many cells: the air of up to 10,000 anchors, whose every random number is a function of a key.

``CellMedium`` runs real machines, up to a few hundred; ``CellWorld`` computes on demand what tags receive; both give
the same stamps. Public: medium, world, timetable.
"""
