"""Figures of a site for Prometheus.

Within the package: exposition, metrics, target.
"""
