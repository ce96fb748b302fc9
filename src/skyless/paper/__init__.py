"""The paper's figures and claims, reproduced in one report."""
