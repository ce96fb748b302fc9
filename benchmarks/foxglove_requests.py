"""A million random requests to the decoder of ``foxglove://``: ``.venv/bin/python benchmarks/foxglove_requests.py``.

Valid requests with bytes changed, cut, repeated and replaced. Ends with an exception if one raises.
"""

import json
import random
import sys
from collections import Counter

from skyless.bridges.foxglove import decode_request

REQUESTS = 1_000_000
VALID = [
    json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 2}, {"id": 2**32 - 1, "channelId": 0}]}),
    json.dumps({"op": "unsubscribe", "subscriptionIds": [1, 2, 3]}),
    json.dumps({"op": "advertise", "channels": [{"id": 1, "topic": "x", "encoding": "json", "schemaName": "y"}]}),
]
PIECES = [
    '"',
    "{",
    "}",
    "[",
    "]",
    "-1",
    "1e999",
    "null",
    "9" * 400,
    "[" * 3000,
    "\\ud800",
    "\x00",
    "\udcff",
    "é",
    '"op":',
    ",",
]


def changed(text, source):
    """The text with up to four changes."""
    for _ in range(source.randrange(5)):
        at = source.randrange(len(text) + 1)
        match source.randrange(4):
            case 0:
                text = text[:at] + source.choice(PIECES) + text[at:]
            case 1:
                text = text[:at]
            case 2:
                text = text[:at] + chr(source.randrange(1, 0x3000)) + text[at + 1 :]
            case _:
                text = text[:at] + text[at // 2 : at] + text[at:]
    return text


def main(count):
    source = random.Random(15)
    found = Counter()
    for _ in range(count):
        data = changed(source.choice(VALID), source)
        found[type(decode_request(data)).__name__] += 1
    print(f"{count} requests: {dict(found)}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else REQUESTS)
