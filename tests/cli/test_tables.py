"""Tables fit the screen: heads are wrapped, numbers are not, and what is too wide goes into further parts."""

import pytest

from skyless.cli.common.output import print_table

HEADS = ("case", "RMSE in cm", "NEES", "", *(f"figure number {n}" for n in range(20)))
ROW = ("a body in between", "2.43 ± 0.05", "1.02", "0.91–1.09", *(f"{n}.{n:05} ± 0.1" for n in range(20)))


def test_many_figures_make_several_tables(capsys):
    print_table("wide", HEADS, [ROW], figures=True, caption="what [it] is")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    rows = [line for line in lines if "│" in line]
    assert len(rows) > 1
    assert all("a body in between" in line for line in rows)
    assert [cell.strip() for line in rows for cell in line.strip("│").split("│")[1:]] == list(ROW[1:])
    assert sum("what [it] is" in line for line in lines) == sum("wide" in line for line in lines) == 1


@pytest.mark.parametrize("figures", [False, True])
def test_few_columns_make_one_table(capsys, figures):
    print_table("narrow", HEADS[:4], [ROW[:4]], figures=figures)
    rows = [line for line in capsys.readouterr().out.splitlines() if "│" in line]
    assert [cell.strip() for cell in rows[0].strip("│").split("│")] == list(ROW[:4])
    assert len(rows) == 1


def test_long_texts_are_wrapped(capsys):
    print_table("words", ("file", "reason"), [("/home/" + 120 * "x", 30 * "because ")])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 100
    assert out.count("x") == 120
    assert out.count("because") == 30
