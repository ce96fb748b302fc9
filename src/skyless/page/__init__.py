"""The web page of a site: its server, and in ``browser/`` what the browser runs."""
