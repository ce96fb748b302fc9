"""The web page of a site: its server, and in ``browser/`` the code for browsers."""
