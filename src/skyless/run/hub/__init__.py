"""The hub: NATS servers where the sites of a company meet (``docs/hub.md``)."""
