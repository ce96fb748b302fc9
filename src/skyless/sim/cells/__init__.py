"""Sites of thousands of anchors, simulated cell by cell."""
