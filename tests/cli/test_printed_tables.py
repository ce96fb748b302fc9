"""Tables fit the screen: heads are wrapped, numbers are not, and what is too wide goes into further tables."""

from skyless.cli.common import print_table

HEADS = ("case", "RMSE in cm", "", *(f"figure number {n}" for n in range(20)))
ROW = ("a body in between", "2.43 ± 0.05", "0.91–1.09", *(f"{n}.{n:05} ± 0.1" for n in range(20)))


def test_many_figures_make_several_tables(capsys):
    print_table("wide", HEADS, [ROW], figures=True, caption="what [it] is")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in lines if "│" in line]
    assert {cells[0] for cells in rows} == {ROW[0]}
    assert [cell for cells in rows for cell in cells[1:]] == list(ROW[1:])
    assert sum("what [it] is" in line for line in lines) == sum("wide" in line for line in lines) == 1
