"""Lists of rules as they come from MQTT or a page, and whom a rule concerns."""

from collections.abc import Mapping, Sequence

from skyless.run.mqtt.messages import AlarmRulesMessage, Asset, WrongMessageError, read_message
from skyless.site.alarm_rules import GROUP, BadAlarmRulesError, check_rules


def read_rules(payload: bytes) -> AlarmRulesMessage:
    """An ``AlarmRulesMessage`` in JSON, all its rules checked. Raises BadAlarmRulesError."""
    try:
        message = read_message(payload, AlarmRulesMessage)
    except WrongMessageError as error:
        raise BadAlarmRulesError(None, "", "the message", str(error), 'a list as {"rules": [...]}') from None
    check_rules(message.rules)
    return message


class Concerned:
    """The tags that ``tags`` or ``others`` of a rule name; all where the list is empty."""

    def __init__(self, names: Sequence[str], assets: Mapping[str, Asset]) -> None:
        self.named = frozenset(name for name in names if not name.startswith(GROUP))
        """Tags that it names by themselves, so that they are expected even if nothing has been heard of them."""
        groups = {name.removeprefix(GROUP) for name in names if name.startswith(GROUP)}
        self.named |= {tag for tag, asset in assets.items() if asset.group in groups}
        self._all = not names

    def __contains__(self, tag: object) -> bool:
        return self._all or tag in self.named
