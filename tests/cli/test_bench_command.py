"""``skyless bench``: what it writes."""

import json

from skyless.cli.main import main


def test_it_measures_the_draws_beside_the_numpy_loop(capsys):
    assert main(["bench", "--draws", "5000", "--anchors", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])["monte_carlo"]
    assert told["anchors"] == 3
    rates = [told["numpy_loop_draws_per_s"], told["one_core_draws_per_s"], told["all_cores_draws_per_s"]]
    assert all(rate > 0.0 for rate in rates)
    assert told["ratio"] == rates[1] / rates[0]


def test_the_table_names_every_way(capsys):
    assert main(["bench", "--draws", "2000"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in ("NumPy loop, one core", "compiled, one core", "GPU"))


def test_too_few_draws_are_a_slip(capsys):
    assert main(["bench", "--draws", "5"]) == 2
    assert "draws" in capsys.readouterr().err
