"""FiRa's UCI: packets and downlink TDoA measurements."""
