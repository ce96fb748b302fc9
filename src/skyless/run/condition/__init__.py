"""The condition of a site: evidence from its messages, and the reasons why its page is green, amber or red.

Public: evidence, monitor.
"""
