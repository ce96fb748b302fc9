"""The survey program of a running site: what anchors received of one another becomes positions, and is watched.

Public: files, program.
Within the package: findings_log, live_survey, precedence.
"""
