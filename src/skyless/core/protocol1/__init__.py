"""Protocol 1, the paper's: a master keeps the site's time, anchors send in slots, another takes over when it fails.

Nothing of protocol 2 imports it; ``skyless.core.any_receiver`` decides which of both a site uses.
"""
