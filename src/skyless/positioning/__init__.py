"""From pseudoranges and time differences to positions: solver, the paper's methods, the estimator."""
