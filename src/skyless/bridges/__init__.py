"""A site's fixes for programs and devices of other kinds: each as its own bytes, over what it reads from."""
