"""What a running site tells over MQTT, made without any broker: simulated tags, their receivers and reception logs."""

import msgspec
from msgspec.structs import replace

from skyless.core.any_receiver import AnyReceiver
from skyless.core.integrity import IntegrityRequirement
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import FixMessage, RequestMessage, SiteMessage, TrueMotion, TruthMessage, fix_message
from skyless.run.recordings.reception_log import ReceptionLog, receiver_settings
from skyless.run.recordings.recorder import McapFile, McapRecorder
from support.bench import LAB, tape

SITE = replace(LAB, georeference=GeoreferenceSite(52.5, 13.4, 34.0, 30.0))
UNIX_S = 1.8e9
USUAL = IntegrityRequirement()
PLACES = {"a": (3.0, 4.0, 0.0), "b": (2.0, 2.0, 0.0), "c": (5.0, 3.0, 0.0)}


def messages(seconds=2.0, tags=("a",), method="joint", join_s=0.5, publish_every=1, integrity=USUAL, **faults):
    """(unix_s, topic, payload) of a site; somebody asks for receptions from ``join_s`` on.

    ``faults``: as of ``machines.bench.Stage``.
    """
    said = [(UNIX_S, topics.site_topic(SITE.id), SiteMessage(SITE, True, UNIX_S))]
    for tag in tags:
        said += list(_of_tag(tag, seconds, method, join_s, publish_every, integrity, faults))
    moments = (0.1 * k for k in range(int(10 * seconds)))
    motion = {tag: TrueMotion(PLACES[tag], (0.0, 0.0, 0.0)) for tag in tags}
    said += [(UNIX_S + s, topics.truth_topic(SITE.id), TruthMessage(UNIX_S + s, motion)) for s in moments]
    return [(s, topic, msgspec.json.encode(message)) for s, topic, message in sorted(said, key=lambda one: one[0])]


def _of_tag(tag, seconds, method, join_s, publish_every, integrity, faults):
    log = ReceptionLog(tag, receiver_settings(method, integrity=integrity), "run")
    receiver, serial = AnyReceiver(method, integrity=integrity), 0
    for one in tape(LAB, seconds, 1, PLACES[tag], **faults):
        host_s = one.host_s
        if host_s >= join_s:
            log.request(RequestMessage("test", ("*",), 10.0), host_s)
        log.add(receiver, one.reception)
        fix = receiver.hear(one.reception)
        if fix is not None:
            serial += 1
            if serial % publish_every == 0:
                message = fix_message(tag, serial, fix, UNIX_S + host_s, 1e-4)
                yield UNIX_S + host_s, topics.fix_topic(SITE.id, tag), message
        while (raw := log.collect(host_s, UNIX_S)) is not None:
            yield UNIX_S + host_s, topics.receptions_topic(SITE.id, tag), raw
    log.interrupt()
    while (raw := log.collect(seconds, UNIX_S)) is not None:
        yield UNIX_S + seconds, topics.receptions_topic(SITE.id, tag), raw


def fixes_of(said):
    return [msgspec.json.decode(payload, type=FixMessage) for _, topic, payload in said if topic.endswith("/fix")]


def record(path, said, flush_s=1.0, close=True, **options):
    """Write them as the recorder does; returns it."""
    recorder = McapRecorder(McapFile(path, **options))
    flushed_s = said[0][0]
    for unix_s, topic, payload in said:
        recorder.add(topic, payload, unix_s)
        if unix_s - flushed_s >= flush_s:
            recorder.file.flush()
            flushed_s = unix_s
    recorder.file.flush()
    if close:
        recorder.file.close()
    return recorder
