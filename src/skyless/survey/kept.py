"""Delays of anchors whose positions are given and stay: the simplest survey."""

from skyless.survey.fit.build import Measured
from skyless.survey.result import Survey


def survey_of_kept_positions(measured: Measured) -> Survey:
    """Delays only."""
    raise NotImplementedError
