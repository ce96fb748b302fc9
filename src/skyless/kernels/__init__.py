"""What estimation computes with: the compiler, array types, small linear algebra.

Public: arrays, cache, compiled, covariance, linear_algebra, processors, two_state.
"""
