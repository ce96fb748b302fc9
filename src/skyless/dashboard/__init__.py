"""The live page: what it shows, and the server that it talks to."""
