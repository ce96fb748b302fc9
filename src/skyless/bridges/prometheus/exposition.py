"""Prometheus's text format, version 0.0.4.

Source: https://prometheus.io/docs/instrumenting/exposition_formats/#text-based-format.
"""

from collections.abc import Iterable, Mapping, Sequence
from math import inf, isinf, isnan
from typing import Final, Literal

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

Labels = Mapping[str, str]
Sample = tuple[Labels, float]
"""Its labels by name, and its value."""

_ESCAPES: Final = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})


def family(name: str, kind: Literal["counter", "gauge"], text: str, samples: Iterable[Sample]) -> list[str]:
    """The lines of one metric; none where it has no samples. ``text`` is one line of help."""
    lines = [_sample(name, labels, value) for labels, value in samples]
    return [*_header(name, kind, text), *lines] if lines else []


def histograms(
    name: str, text: str, bounds: Sequence[float], samples: Iterable[tuple[Labels, Sequence[int], float]]
) -> list[str]:
    """The lines of a histogram: of each sample its labels, how many values each bucket got, and their sum.

    ``bounds`` are the upper ends of the buckets, rising; one more count is of values above them all.
    """
    lines = []
    for labels, counts, total in samples:
        below = 0
        for bound, count in zip((*bounds, inf), counts, strict=True):
            below += count
            lines.append(_sample(f"{name}_bucket", {**labels, "le": _number(bound)}, below))
        lines += [_sample(f"{name}_sum", labels, total), _sample(f"{name}_count", labels, below)]
    return [*_header(name, "histogram", text), *lines] if lines else []


def _header(name: str, kind: str, text: str) -> list[str]:
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}"]


def _sample(name: str, labels: Labels, value: float) -> str:
    inside = ",".join(f'{key}="{text.translate(_ESCAPES)}"' for key, text in labels.items())
    return f"{name}{{{inside}}} {_number(value)}" if inside else f"{name} {_number(value)}"


def _number(value: float) -> str:
    if isnan(value):
        return "NaN"
    if isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return repr(value)
