"""Folders that cannot be written, and files of a history that no program of ours wrote."""

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from skyless.cli.main import main
from skyless.core.errors import SkylessError
from skyless.run.history.answers import Span
from skyless.run.history.layout import EVENT_COLUMNS, FIX_COLUMNS, NAME_COLUMNS, file_name, site_folder
from skyless.run.history.queries import History
from support.parquet_files import ARROW_TYPES, arrow_table

pytestmark = pytest.mark.site

QUESTIONS = {
    "track": lambda history, span: history.track("a", span),
    "heatmap": lambda history, span: history.heatmap(span),
    "contacts": lambda history, span: history.contacts("a", span),
    "dwell": lambda history, span: history.dwell(span),
    "sql": lambda history, span: history.sql("SELECT count(*) FROM fixes JOIN events USING (tag)", span),
    "written": lambda history, span: history.write("FROM fixes", span, history.folder / "all.csv"),
    "zones": lambda history, _span: history.zones(),
    "newest": lambda history, _span: history.known_until_unix_s(),
}
INTEGERS = {pa.int32(): np.int32, pa.uint32(): np.uint32, pa.uint16(): np.uint16}
DAY_MS = 86_400_000


def column(kind, draw):
    """Values that no program writes: the least and the largest ones, others, and none."""
    if pa.types.is_timestamp(kind):
        return pa.array([draw.choice([-(2**62), -1, 0, 20_000 * DAY_MS, 2**62]) for _ in range(50)], pa.int64()).cast(
            kind
        )
    if pa.types.is_string(kind):
        return pa.array([draw.choice(["", "a", "enter", "leave", "\0", "ä" * 9_000, None]) for _ in range(50)], kind)
    limits = np.iinfo(INTEGERS[kind])
    return pa.array([draw.choice([int(limits.min), 1, int(limits.max), None]) for _ in range(50)], kind)


@pytest.mark.parametrize("seed", range(6))
def test_a_history_of_extreme_values_answers_or_says_why_not(tmp_path, seed):
    draw, site = np.random.default_rng(seed), site_folder(tmp_path, 1)
    for folder, columns in ((site, FIX_COLUMNS), (site / "events", EVENT_COLUMNS)):
        (folder / "day=2024-10-04").mkdir(parents=True)
        table = pa.table({name: column(ARROW_TYPES[kind], draw) for name, kind in columns.items()})
        if columns is FIX_COLUMNS and seed > 3:
            table = table.drop_columns(["flags"]) if seed > 4 else table.set_column(2, "x_mm", pa.array(["a"] * 50))
        parquet.write_table(table, folder / "day=2024-10-04" / file_name(1, 50))
    names = arrow_table(NAME_COLUMNS, {"tag": [1], "name": ["a"], "since": [0]})
    parquet.write_table(names, site / "names.parquet")
    zones = pa.table({"zone": ["z", None], "name": [None, "n"], "corners_m": ["[[[[", None]})
    parquet.write_table(zones, site / "zones.parquet")
    for span in (Span(0.0, 2e9), Span(1.728e9 - 10.0, 1.728e9 + 1e6)):
        for ask in QUESTIONS.values():
            try:
                ask(History(tmp_path, 1), span)
            except SkylessError as error:
                assert "\n" not in str(error)


@pytest.mark.parametrize(
    "words",
    [("history", "run", "--to"), ("site", "new"), ("broker", "--port", "1", "--data"),
     ("hub", "init", "--node", "127.0.0.1:4222", "--sites", "7"), ("broker", "access")],
)  # fmt: skip
def test_a_folder_that_cannot_be_written_is_one_line(words, tmp_path, capsys):
    (tmp_path / "file").touch()
    rest = ("--mqtt", "mqtt://127.0.0.1:9") if words[0] == "history" else ()
    assert main([*words, str(tmp_path / "file" / "x"), *rest]) == 2
    said = capsys.readouterr().err.strip()
    assert str(tmp_path / "file") in said.replace("\n", "") and "Traceback" not in said
