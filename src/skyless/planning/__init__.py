"""Planning: what a site will give before anything is mounted, and where its anchors should hang."""
