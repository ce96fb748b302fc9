"""The HTTP interface, version 1 (``docs/http.md``): ``routes.ROUTES`` lists all that programs can ask for."""
