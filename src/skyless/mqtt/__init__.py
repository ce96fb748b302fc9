"""MQTT: topics, messages, the link to a broker.

Public: access, access_files, address, connection, fix_message, leases, link, messages, outbox, survey_facts, topics,
truth_buffer.
"""
