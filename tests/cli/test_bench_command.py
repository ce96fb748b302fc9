"""``skyless bench``: what it writes."""

import functools
import json

import pytest

from skyless.cli.main import main
from skyless.research.bench import measure, monte_carlo_speed


@pytest.mark.statistical
def test_it_measures_everything_next_to_its_baselines_and_the_table_names_every_way(capsys, monkeypatch):
    measured = functools.cache(measure.measure_all), functools.cache(monte_carlo_speed.measure)
    monkeypatch.setattr(measure, "measure_all", measured[0])  # the table shows the same run
    monkeypatch.setattr(monte_carlo_speed, "measure", measured[1])
    arguments = ["bench", "--quick", "--draws", "5000", "--anchor-count", "3"]
    assert main([*arguments, "--json"]) == 0
    everything = json.loads(capsys.readouterr().out.splitlines()[-1])
    told = everything["monte_carlo"]
    assert told["anchors"] == 3
    rates = [told["numpy_loop_draws_per_s"], told["one_core_draws_per_s"], told["all_cores_draws_per_s"]]
    assert all(rate > 0.0 for rate in rates)
    assert told["ratio"] == rates[1] / rates[0]
    kernels = everything["kernels"]
    assert kernels["streaming"]["seconds_per_message"] > 0.0
    for name in ("joint", "joint_mesh", "joint_room", "joint_room_mesh"):
        kernel = kernels[name]
        assert kernel["ratio"] == kernel["messages_per_s"] / kernel["numpy_messages_per_s"] > 1.0
        assert kernel["loop_ratio"] == kernel["messages_per_s"] / kernel["loop_messages_per_s"] > 0.0
    for tags in everything["tags"].values():
        assert set(tags["ns_per_message"]) == {"1", "100", "10000"}
        assert tags["all_cores_messages_per_s"] > 0.0
    assert everything["snapshots"]["ratio"] > 0.0
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert all(
        name in told
        for name in (
            "joint, mesh",
            "Receiver, joint",
            "least_squares",
            "NumPy loop, one core",
            "compiled, one core",
        )
    )


def test_too_few_draws_are_a_slip(capsys):
    assert main(["bench", "--draws", "5"]) == 2
    assert "draws" in capsys.readouterr().err
