"""What estimation computes with: the compiler, array types, small linear algebra.

Public: arrays, compiled, covariance, linear_algebra, two_state.
"""
