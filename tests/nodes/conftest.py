"""The brokers of ``tests/mqtt`` and the boards of ``tests/radios`` serve here too."""

import sys
from pathlib import Path

import pytest

sys.path += [str(Path(__file__).parents[1] / name) for name in ("mqtt", "radios")]


@pytest.fixture
def links(monkeypatch):
    """Links of ``node_stage.FakeLink``, in the order in which they were made."""
    from node_stage import FakeLink

    monkeypatch.setattr(FakeLink, "made", [])
    return FakeLink.made
