"""Authentication of beacons: the site's key chain, its certificates, and how a listener verifies what it receives.

As in Galileo's OSNMA (TESLA): codes are made with keys that are disclosed later, so a listener needs no secret, but
must know the time (``docs/authentication.md``).

Public: certificate, chain, chain_maker, fault, key_chain, key_files, verifier. Within the package: arrivals,
known_keys, site_clock.
"""
