"""What the commands of a running site say to wrong input, before anything starts."""

import pytest

from skyless.cli.main import main


@pytest.mark.parametrize(
    ("command", "right"),
    [
        ("anchor", "IDS is missing; it should be one or more of the site's, each once: 1 2 3 4 5 6"),
        ("anchor 1 1", "IDS is 1 1"),
        ("anchor 7", "IDS is 7"),
        ("tag", "NAMES is missing"),
        ("tag a a", "NAMES is 'a a'"),
        (f"tag {'x' * 33}", "1 to 32 letters"),
        ("tag t --method magic", "it should be one of literal"),
        ("ether --site lab:loud", "--site is 'lab:loud'; it should be a site file, lab, or lab:PICOSECONDS"),
        ("ether --listen 127.0.0.1:port", "--listen is '127.0.0.1:port'; it should be HOST:PORT"),
        ("ether --listen 70000", "--listen is '70000'"),
        ("demo --mqtt none", "the demo needs a broker"),
        ("record --mqtt none", "it should be the broker of the site to record"),
    ],
)
def test_wrong_input_is_told_with_what_would_be_right(command, right, capsys):
    assert main(command.split()) == 2
    assert right in capsys.readouterr().err
