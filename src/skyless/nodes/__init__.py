"""The programs of a running site, asyncio around the protocol machines.

Public: anchor, board, broker, broker_address, demo, ether, find_site, fix_log, open_radio, packet_tags, ports,
process, radio_monitor, record, tag, watch.
Within the package: children, lateness, stamp_log. The survey program and the bridges have folders of their own.
"""
