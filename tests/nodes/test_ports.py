"""Which port a program takes, also when another looks at the same moment."""

import socket

import pytest

from skyless.nodes.ports import claim, claim_next, hold_any, is_free

HOST = "127.0.0.1"


def any_port(host):
    """A port that is free at this moment."""
    port, held = hold_any(host)
    held.close()
    return port


def test_a_port_that_is_taken_is_passed_over():
    with socket.socket() as one:
        one.bind((HOST, 0))
        port = one.getsockname()[1]
        one.listen()
        assert not is_free(HOST, port)
        found, held = claim_next(HOST, port)
        with held:
            assert found > port
        assert any_port(HOST) != port


def test_a_port_that_was_just_left_is_free():
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection((HOST, port)):
            served, _ = server.accept()
            served.close()  # the server's side closes first and waits in TIME_WAIT
    assert is_free(HOST, port)


def test_two_that_look_at_once_get_two_ports_and_a_claim_that_ends_frees_its_own():
    port = any_port(HOST)
    first, held = claim_next(HOST, port)
    second, other = claim_next(HOST, port)
    assert second > first
    assert claim(HOST, first) is None
    held.close()
    other.close()
    again = claim(HOST, first)
    assert again is not None
    again.close()


def test_a_held_port_is_given_to_nobody_but_to_who_asks_for_it():
    port, held = hold_any(HOST)
    with held, socket.create_server((HOST, port)) as server, socket.create_connection((HOST, port)) as caller:
        assert server.accept()[1] == caller.getsockname()


def test_an_address_of_another_machine_is_never_free():
    with pytest.raises(OSError, match="assign"):
        is_free("192.0.2.200", 4711)
