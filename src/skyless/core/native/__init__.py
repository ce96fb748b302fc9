"""The part of ``core`` that is also C: its types, its arithmetic, and the library compiled from it."""
