"""Authentication of beacons: key chain, certificates, and how a listener verifies what it receives."""
