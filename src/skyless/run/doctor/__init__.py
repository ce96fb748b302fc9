"""``skyless doctor``: checks of a computer, its boards and a running site, and the report of them."""
