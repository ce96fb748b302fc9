"""A survey's shape with what tags received: they add to it, and choose between results that the ranges leave open."""

import numpy as np
from msgspec import structs

from skyless.survey.fit.ambiguity import OtherFit
from skyless.survey.fit.problem import solve_least_squares
from skyless.survey.shape import Fitted, with_tag
from skyless.survey.tags.epochs import TagEpochs
from skyless.survey.tags.joint import fit_with_tag


def with_tags(fitted: Fitted, others: tuple[OtherFit, ...]) -> tuple[Fitted, tuple[OtherFit, ...]]:
    """The shape with all tags that fit it, and those of the other results that they do not rule out.

    Sentences say what was used and what was not.
    """
    ranges_m = {(pair.a, pair.b): pair.range_m for pair in fitted.measured.pairs}
    for epochs in fitted.measured.facts.tags:
        assert isinstance(epochs, TagEpochs)
        used = [fitted.used, *(other.used for other in others)]
        elsewhere = [solve_least_squares(fitted.problem, one.position_m, one.used.astype(np.float64)) for one in others]
        alone = [fitted.solution, *elsewhere]
        joint = fit_with_tag(fitted.problem, fitted.anchors, alone, epochs, ranges_m, used)
        notes = (*fitted.notes, joint.sentence)
        if joint.solution is not None and joint.rows is not None:
            if joint.chosen:
                notes = (*notes, f"{epochs.name} contradicts the result that fits the ranges best: another was chosen")
            fitted = with_tag(fitted, joint.rows, joint.solution, used[joint.chosen])
            others = tuple(others[number - 1] for number in joint.possible if number and number != joint.chosen)
        fitted = structs.replace(fitted, notes=notes)
    return fitted, others
