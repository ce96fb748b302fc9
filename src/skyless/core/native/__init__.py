"""The part of ``core`` that is also C: its types and arithmetic, and the library that is made from it."""
