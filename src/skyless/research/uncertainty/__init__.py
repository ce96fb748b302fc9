"""Lower bounds of the position error, and the error along the chain of stamps."""
