"""What all results have: a short table in a notebook, one line elsewhere, a table for pandas."""

from collections.abc import Iterator, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.extras import extra_module

if TYPE_CHECKING:
    from pandas import DataFrame


class Result(Struct, frozen=True, eq=False):
    """A result; two are equal only if they are the same one, as their arrays have no single answer."""

    def title(self) -> str:
        """What the result is of."""
        raise NotImplementedError

    def facts(self) -> Iterator[tuple[str, str]]:
        """The figures that matter, each with its name and unit."""
        raise NotImplementedError

    def __repr__(self) -> str:
        facts = "; ".join(f"{name} {value}" for name, value in self.facts())
        return f"{type(self).__name__}({self.title()}: {facts})"

    def _repr_html_(self) -> str:
        """The figures as a table, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:right'>{escape(value)}</td></tr>"
            for name, value in self.facts()
        )
        return f"<table><caption>{escape(self.title())}</caption><tbody>{rows}</tbody></table>"


def data_frame(columns: Mapping[str, Any]) -> "DataFrame":
    """Columns as a table of pandas. Raises SkylessError where pandas is not installed."""
    frame: DataFrame = extra_module("pandas", "to_dataframe").DataFrame(dict(columns))
    return frame


def axes_columns(prefix: str, values: Array, suffix: str = "") -> dict[str, Array]:
    """An array of shape (n, 3) as columns x, y, z."""
    return {f"{prefix}{axis}{suffix}": values[:, number] for number, axis in enumerate("xyz")}


def figures(values: Any) -> Array:  # noqa: ANN401 - whatever has numbers and None
    """Numbers as an array of floats, NaN for None."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
