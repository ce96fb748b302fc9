"""Runs where ROS 2 is: reads a bag's MCAP, each message by ROS's own type support, and writes what it read as JSON."""

import json
import sys
from importlib import import_module
from pathlib import Path

from mcap.reader import make_reader
from rclpy.serialization import deserialize_message


def plain(value):
    """A message as JSON has it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, bytes):
        return list(value)
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def main():
    found = []
    with Path(sys.argv[1]).open("rb") as file:
        reader = make_reader(file)
        profile = reader.get_header().profile
        for schema, channel, message in reader.iter_messages():
            package, kind, name = schema.name.split("/")
            message_type = getattr(import_module(f"{package}.{kind}"), name)
            coding = f"{channel.message_encoding}/{schema.encoding}"
            read = plain(deserialize_message(message.data, message_type))
            found.append([channel.topic, coding, message.log_time, read])
    print(json.dumps({"profile": profile, "messages": found}))


if __name__ == "__main__":
    main()
