"""Which topics a topic filter means (MQTT 3.1.1, section 4.7)."""


def matches(topic_filter: str, topic: str) -> bool:
    """Whether a subscription to the filter brings the topic; ``+`` is one level, ``#`` the rest."""
    if topic.startswith("$") != topic_filter.startswith("$"):
        return False
    wanted, levels = topic_filter.split("/"), topic.split("/")
    if wanted[-1] == "#":
        wanted = wanted[:-1]
        levels = levels[: len(wanted)]
    return len(wanted) == len(levels) and all(want in ("+", level) for want, level in zip(wanted, levels, strict=True))
