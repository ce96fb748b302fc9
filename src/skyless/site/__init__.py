"""Setting up a site: its file, its survey, and the planning of its anchors."""
