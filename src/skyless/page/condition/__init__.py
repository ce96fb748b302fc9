"""How a site is: what its messages show, and the reasons why its page is green, amber or red.

Public: evidence, monitor.
"""
