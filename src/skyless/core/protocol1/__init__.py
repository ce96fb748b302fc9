"""Protocol 1, the paper's: a master keeps the site's time, anchors send in slots, another takes over when it fails.

Nothing in protocol 2 imports it; ``skyless.core.any_receiver`` decides which one a site uses.
"""
