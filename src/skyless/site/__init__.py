"""What a site is made from: its file, its survey, and the planning of its anchors."""
