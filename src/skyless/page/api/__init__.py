"""The HTTP interface, version 1 (``docs/http.md``): ``routes.ROUTES`` lists everything that programs can request."""
