"""Every recording below a folder by every method, beside each other."""
