"""What is on the air: beacons and their bytes, the almanac's pages, and what a radio reports of a frame.

Public: almanac, beacon, beacon2, codec, codec2, dl_tdoa, frames, ieee802154, master_term, masterless_packets,
page_codec, reception, site_choice, uci, uci_location.
"""
