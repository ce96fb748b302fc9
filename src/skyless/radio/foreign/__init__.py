"""Formats of devices of other makers: Bitcraze's anchors and sniffers, and FiRa's UCI."""
