"""Surveys in simulated rooms, and their errors."""
