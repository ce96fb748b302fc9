"""The gather of a site: fixes of many tags packed into batches, and the streams of NATS that keep them."""
