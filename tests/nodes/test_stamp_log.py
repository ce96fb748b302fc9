"""What an anchor keeps for those who ask for its stamps."""

from skyless.mqtt.leases import MAX_LEASE_S, MOST_LEASES, Leases
from skyless.mqtt.messages import RequestMessage, Stamp
from skyless.nodes.stamp_log import MOST_PENDING_STAMPS, STAMPS_INTERVAL_S, StampLog


def request(by, lease_s=10.0, stamps=True):
    return RequestMessage(by, (), lease_s, stamps)


def test_nothing_is_kept_until_somebody_asks():
    log = StampLog(2, "a")
    log.add(1, 10, 20)
    assert log.collect(100.0, 0.0) is None
    log.request(request("me"), 100.0)
    log.add(1, 11, 21)
    log.add(3, 12, 22)
    message = log.collect(100.1, 5.0)
    assert (message.anchor, message.run, message.unix_s, message.missed) == (2, "a", 5.0, 0)
    assert message.stamps == (Stamp(1, 11, 21), Stamp(3, 12, 22))


def test_messages_come_at_an_interval_also_when_nobody_is_received():
    log = StampLog(2, "a")
    log.request(request("me"), 100.0)
    assert log.collect(100.0, 0.0).stamps == ()
    assert log.collect(100.0 + 0.9 * STAMPS_INTERVAL_S, 0.0) is None
    log.add(1, 10, 20)
    assert log.collect(100.0 + STAMPS_INTERVAL_S, 0.0).stamps == (Stamp(1, 10, 20),)


def test_what_is_not_collected_takes_no_memory_and_is_counted():
    log = StampLog(2, "a")
    log.request(request("me"), 100.0)
    for number in range(MOST_PENDING_STAMPS + 7):
        log.add(1, number, number)
    message = log.collect(101.0, 0.0)
    assert len(message.stamps) == MOST_PENDING_STAMPS
    assert message.missed == 7
    assert message.stamps[0].tx_ticks == 7
    log.add(1, 1, 1)
    assert log.collect(102.0, 0.0).missed == 0


def test_a_lease_ends_by_its_time_or_by_a_request_without_stamps():
    log = StampLog(2, "a")
    log.request(request("me", 10.0), 100.0)
    log.request(request("other", 1e9), 100.0)
    log.request(request("other", stamps=False), 101.0)
    log.add(1, 1, 1)
    assert log.collect(110.0, 0.0) is None
    assert not log.wanted
    log.add(1, 1, 1)
    log.request(request("me"), 120.0)
    assert log.collect(120.0, 0.0).stamps == ()  # nothing of before


def test_a_counter_that_restarts_begins_another_run():
    log = StampLog(2, "a")
    log.request(request("me"), 100.0)
    log.add(1, 1, 1)
    log.restart("b")
    log.add(1, 2, 2)
    message = log.collect(100.5, 0.0)
    assert (message.run, message.stamps) == ("b", (Stamp(1, 2, 2),))


def test_leases_are_bounded_in_number_and_length():
    leases = Leases()
    assert all(leases.grant(str(number), 1e9, 0.0) for number in range(MOST_LEASES))
    assert not leases.grant("one more", 1.0, 0.0)
    assert leases.grant("0", 1.0, 0.0)  # who has one may extend it
    leases.expire(MAX_LEASE_S)
    assert not leases.are_held
    assert leases.grant("one more", 1.0, MAX_LEASE_S)
