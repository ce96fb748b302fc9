"""The paper's figures and claims, simulated, judged and written as one report."""
