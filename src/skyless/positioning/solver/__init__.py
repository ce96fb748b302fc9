"""A position from time differences or pseudoranges of one moment, without a history."""
