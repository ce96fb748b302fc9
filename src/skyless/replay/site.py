"""Replay of a running site: every tag's receptions once more, judged against the truth and the recorded fixes."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Final, cast

import numpy as np

from skyless.errors import ConfigurationError
from skyless.evaluation.judge import Judge
from skyless.mqtt.messages import FixMessage, ReceptionsMessage
from skyless.positioning.integrity import IntegrityRequirement
from skyless.recordings.mcap.recording import McapRecording, Recorded
from skyless.recordings.truth import Truth
from skyless.replay.antenna_delays import delay_changes
from skyless.replay.comparison import Identical
from skyless.replay.foreign import ReplayReport
from skyless.replay.tag import Replayed, TagReplay
from skyless.site.model import Site

FORMAT: Final = "skyless-mcap"


class TagReport(ReplayReport, frozen=True, kw_only=True):
    """What the replay of one tag came to; times are Unix seconds."""

    tag: str
    identical: Identical | None
    """Against the fixes that the tag published; None with another method than its own."""
    segments: int
    """Runs of receptions without a gap."""
    cold_starts: int
    """How many of them did not begin where the tag's receiver was."""


class SiteReplay:
    """All tags of a recording, or some of them."""

    def __init__(
        self,
        recording: McapRecording,
        tags: Iterable[str] | None = None,
        method: str | None = None,
        settle_s: float = 2.0,
        above_m: float | None = None,
        wanted: Site | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Replay as the tags computed, or otherwise.

        ``method`` and ``integrity`` are used instead of the tags' own, the antenna delays of ``wanted`` instead of the
        anchors' own.

        Raises:
            ConfigurationError: the recording has no raw receptions, none of such a tag, or is of another site.
        """
        summary = recording.summary()
        if not summary.raw_tags:
            raise ConfigurationError(summary.path, "raw receptions", None, "a recording that skyless record made")
        for tag in tags or ():
            if tag not in summary.raw_tags:
                raise ConfigurationError(summary.path, "tag", tag, f"one of {', '.join(summary.raw_tags)}")
        self._recording = recording
        self._settle_s = settle_s
        site = recording.site
        self.height_m = None if site is None else site.site.tags.height_m
        self._begin_s = summary.start_s or 0.0
        truth = recorded_truth(recording)
        delays = None
        if wanted is not None:
            delays = delay_changes(recorded_site(recording, wanted.id), wanted)
        self.tags = {tag: TagReplay(tag, method, delays, integrity) for tag in tags or summary.raw_tags}
        self.judges = {
            tag: Judge(truth.get(tag), planar=self.height_m is not None, settle_s=settle_s, above_m=above_m)
            for tag in self.tags
        }
        self._spans: dict[str, tuple[float, float]] = {}
        """First and last fix of each tag, Unix time."""

    def run(
        self, on_fix: Callable[[str, Replayed], None] | None, on_progress: Callable[[float], None]
    ) -> list[TagReport]:
        """Replay all; ``on_progress`` is told now and then the recording's seconds done so far."""
        begun_s = time.perf_counter()
        for number, found in enumerate(self._recording.messages({"receptions", "fix"})):
            if found.place.name in self.tags:
                self._take(found, on_fix)
            if number % 256 == 0:
                on_progress(found.time_s - self._begin_s)
        wall_s = time.perf_counter() - begun_s
        return [self._report(tag, wall_s) for tag in self.tags]

    def _take(self, found: Recorded, on_fix: Callable[[str, Replayed], None] | None) -> None:
        tag = found.place.name
        replay, judge = self.tags[tag], self.judges[tag]
        if found.place.kind == "fix":
            replay.compare(cast("FixMessage", found.message))
            return
        for made in replay.hear(cast("ReceptionsMessage", found.message)):
            first_s, _ = self._spans.get(tag, (made.unix_s, 0.0))
            self._spans[tag] = (first_s, made.unix_s)
            x, y, z = made.fix.position_m.tolist()
            judge.add(made.unix_s, made.unix_s - (replay.begun_s or 0.0), (x, y, z))
            if on_fix is not None:
                on_fix(tag, made)

    def _report(self, tag: str, wall_s: float) -> TagReport:
        replay, judgement = self.tags[tag], self.judges[tag].judgement()
        first_s, last_s = self._spans.get(tag, (0.0, 0.0))
        drops = replay.all_drops()
        return TagReport(
            format=FORMAT,
            receptions=replay.receptions,
            fixes=replay.fixes,
            dropped=sum(drops.values()),
            median_m=judgement.median_m,
            std_m=judgement.std_m,
            rmse_2d_m=judgement.errors.rmse_2d_m,
            rmse_3d_m=judgement.errors.rmse_3d_m,
            p95_m=judgement.errors.p95_m,
            max_m=judgement.errors.max_m,
            rate_hz=replay.fixes / (last_s - first_s) if last_s > first_s else None,
            tdoa_noise_m=None,
            bias_m=judgement.errors.bias_m,
            first_fix_s=first_s - replay.begun_s if replay.fixes and replay.begun_s is not None else None,
            height_m=self.height_m,
            reason=None if replay.fixes else replay.reason,
            drops=drops,
            pairs=(),
            wall_s=wall_s,
            receptions_per_s=replay.receptions / wall_s if wall_s > 0.0 else 0.0,
            tag=tag,
            method=replay.method,
            measurements=None,
            contradictions_m={},
            identical=replay.identical,
            segments=replay.segments,
            cold_starts=replay.cold_starts,
        )


def recorded_site(recording: McapRecording, identifier: int | None = None) -> Site:
    """The site of a recording.

    Raises:
        ConfigurationError: it does not tell its site, or another one than ``identifier`` is wanted.
    """
    told = recording.site
    if told is None:
        raise ConfigurationError(recording.summary().path, "the site", None, "told by the recording")
    if identifier is not None and told.site.id != identifier:
        raise ConfigurationError(recording.summary().path, "the site's id", told.site.id, f"{identifier}, as in --site")
    return told.site


def recorded_truth(recording: McapRecording) -> dict[str, Truth]:
    """Where each tag truly was, by Unix time; times that go back are left out."""
    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    for moment in recording.truth():
        for tag, motion in moment.tags.items():
            known = rows[tag]
            if not known or moment.unix_s > known[-1][0]:
                known.append((moment.unix_s, *motion.position_m))
    tables = {tag: np.array(known) for tag, known in rows.items()}
    return {tag: Truth(table[:, 0], table[:, 1:], None) for tag, table in tables.items()}
