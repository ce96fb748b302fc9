"""Answers in JSON of the page's server."""

from typing import Final

import msgspec
from starlette.responses import Response

JSON: Final = "application/json"


def json_answer(value: object, status: int = 200, media_type: str = JSON) -> Response:
    """A value, or bytes that are JSON, and a newline: in a terminal the prompt then begins a line of its own."""
    whole = value if isinstance(value, bytes) else msgspec.json.encode(value)
    return Response(whole + b"\n", status, media_type=media_type)
