"""The programs of a running site, asyncio around the protocol machines.

Public: anchor, board, broker, demo, ether, find_site, open_radio, packet_tags, process, record,
survey, survey_files, tag, watch.
Within the package: children, fix_log, live_survey, ports, radio_monitor, stamp_log.
"""
