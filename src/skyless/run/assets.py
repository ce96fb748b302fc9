"""Assets, to which tags are attached: validation of lists, and conversion from and to CSV for spreadsheets."""

import csv
import io
import re
from collections.abc import Iterable
from typing import Final

import msgspec

from skyless.run.mqtt.messages import Asset, AssetsMessage, WrongMessageError, read_message

MAX_ASSETS: Final = 10_000
MAX_BYTES: Final = 4_000_000
"""Size limit of a list in JSON or CSV; brokers take messages of 8 MB."""

COLUMNS: Final = Asset.__struct_fields__
"""Header of CSV tables that are written."""

_TAG: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_FORMULA: Final = ("=", "+", "-", "@", "'")
"""Beginnings of cells that a spreadsheet may compute, and the apostrophe, which marks escaped text."""
_COLOUR: Final = re.compile(r"(#[0-9A-Fa-f]{6})?")
_MAX_LENGTHS: Final = {"name": 100, "group": 64, "icon": 8, "owner": 100, "notes": 1000}


def read_assets(payload: bytes) -> AssetsMessage:
    """Read an ``AssetsMessage`` in JSON and check its assets. Raises WrongMessageError."""
    message = read_message(payload, AssetsMessage)
    check_assets(message.assets)
    return message


def check_assets(assets: tuple[Asset, ...]) -> None:
    """Check a list of assets. Raises WrongMessageError, naming asset, key, value and what is allowed."""
    if len(assets) > MAX_ASSETS:
        raise WrongMessageError(f"there are {len(assets)} assets; at most {MAX_ASSETS} are allowed")
    known: set[str] = set()
    for asset in assets:
        fault = "the tag has two assets; it should have one" if asset.tag in known else _fault(asset)
        if fault:
            raise WrongMessageError(f"asset {asset.tag[:40]!r}: {fault}")
        known.add(asset.tag)
    size = len(msgspec.json.encode(assets))
    if size > MAX_BYTES:
        raise WrongMessageError(f"the list has {size} bytes; it should have {MAX_BYTES} at most: shorten the notes")


def _fault(asset: Asset) -> str:
    """Describe the fault of an asset; empty if there is none."""
    if not _TAG.fullmatch(asset.tag):
        return f"tag is {asset.tag[:40]!r}; it should be 1 to 64 letters, digits, dots, dashes and underscores"
    for key, most in _MAX_LENGTHS.items():
        value = getattr(asset, key)
        if len(value) > most:
            return f"{key} is {value[:40]!r}; it should have {most} characters at most, not {len(value)}"
        if not all(letter.isprintable() or letter in "\u200d\n\t" for letter in value):
            return f"{key} is {value[:40]!r}; it should have no control characters"
    if not _COLOUR.fullmatch(asset.colour):
        return f"colour is {asset.colour[:40]!r}; it should be #rrggbb, as #c2410c, or empty"
    return ""


def write_csv(assets: Iterable[Asset]) -> bytes:
    """Write a table in CSV (RFC 4180), UTF-8. Cells that look like a formula get an apostrophe in front."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(COLUMNS)
    for asset in assets:
        writer.writerow(f"'{cell}" if cell.startswith(_FORMULA) else cell for cell in msgspec.structs.astuple(asset))
    return out.getvalue().encode()


def read_csv(data: bytes) -> tuple[Asset, ...]:
    """Read and check the assets in a table, separated by commas, semicolons or tabs, as spreadsheets write them.

    The header names the columns: ``tag``, and any of the others in any order.

    Raises WrongMessageError: naming the line.
    """
    if len(data) > MAX_BYTES:
        raise WrongMessageError(f"the table has {len(data)} bytes; it should have {MAX_BYTES} at most")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise WrongMessageError(f"line {line}: it is not UTF-8; save the table as CSV UTF-8") from None
    head = text.partition("\n")[0]
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=head.count), strict=True)
    found: dict[str, tuple[int, Asset]] = {}
    try:
        columns = _columns(next(rows, []))
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            fault = f"it has {len(row)} cells; it should have {len(columns)}, as the head"
            if len(row) == len(columns):
                asset = Asset(**{name: _text(cell.strip()) for name, cell in zip(columns, row, strict=True)})
                fault = _fault(asset)
                if asset.tag in found:
                    fault = f"tag {asset.tag!r} stands in line {found[asset.tag][0]} already"
                found[asset.tag] = rows.line_num, asset
            if fault:
                raise WrongMessageError(f"line {rows.line_num}: {fault}")
    except csv.Error as error:
        raise WrongMessageError(f"line {rows.line_num}: this is no CSV: {error}") from None
    assets = tuple(asset for _, asset in found.values())
    check_assets(assets)
    return assets


def _text(cell: str) -> str:
    """Remove the apostrophe that ``write_csv`` puts in front of a cell."""
    return cell[1:] if cell[:1] == "'" and cell[1:].startswith(_FORMULA) else cell


def _columns(head: list[str]) -> list[str]:
    columns = [name.strip().lower() for name in head]
    wrong = [name for name in columns if name not in COLUMNS or columns.count(name) > 1]
    if "tag" not in columns or wrong:
        fault = f"the head has {wrong[0][:40]!r}" if wrong else "the head has no column tag"
        raise WrongMessageError(f"line 1: {fault}; it should have tag and any of {', '.join(COLUMNS[1:])}, each once")
    return columns


def assets_at(message: AssetsMessage, site: str) -> dict[str, Asset]:
    """Assets by tag at the site of this name; none if they belong to another site with the same number."""
    return {asset.tag: asset for asset in message.assets} if message.site in ("", site) else {}
