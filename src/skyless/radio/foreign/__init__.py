"""What devices of other makers send: Bitcraze's anchors and sniffers, and FiRa's UCI."""
