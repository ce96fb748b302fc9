"""Errors of the receiver over many simulated runs, one module for each study."""
