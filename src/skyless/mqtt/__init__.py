"""MQTT: topics, messages, the link to a broker.

Public: address, connection, fix_message, leases, link, messages, survey_facts, topics, truth_buffer.
Within the package: outbox.
"""
