"""The algebra of ``joint``: sparse measurements, and a covariance that changes by terms sign·u·uᵀ.

Terms are collected while a packet is taken and added to the covariance in one go, four at a time; until then whoever
asks for a product P·h gets theirs as well. As u_i·u_j = u_j·u_i to the bit, the covariance stays symmetric to the bit.
"""

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.positioning.joint_state import MOST_TERMS, PLACES, TERMS, JointArrays, states, width
from skyless.positioning.protection_updates import follow_faults


@borrowing_kernel
def put(s: JointArrays, place: int, value: float) -> None:
    """Set one more element of the measurement."""
    count = s.counts[PLACES]
    s.h_places[count] = place
    s.h[count] = value
    s.counts[PLACES] = count + 1


@borrowing_kernel
def new_term(s: JointArrays, sign: float) -> int:
    """Begin a term; its place among them."""
    if s.counts[TERMS] == MOST_TERMS:
        settle(s)
    term: int = s.counts[TERMS]
    s.signs[term] = sign
    return term


@borrowing_kernel
def project(s: JointArrays) -> int:
    """Write P·h of the measurement to a new term, not yet counted among the terms; returns its place."""
    new = new_term(s, -1.0)
    P, h, places, u, columns = s.P, s.h, s.h_places, s.terms, width(s)
    count = s.counts[PLACES]
    while count % 4 != 0:  # to whole fours, with nothing
        places[count] = 0
        h[count] = 0.0
        count += 1
    for k in range(0, count, 4):
        a, b, c, d = places[k], places[k + 1], places[k + 2], places[k + 3]
        ha, hb, hc, hd = h[k], h[k + 1], h[k + 2], h[k + 3]
        if k == 0:
            for column in range(columns):
                u[new, column] = ha * P[a, column] + hb * P[b, column] + hc * P[c, column] + hd * P[d, column]
        else:
            for column in range(columns):
                u[new, column] += ha * P[a, column] + hb * P[b, column] + hc * P[c, column] + hd * P[d, column]
    for term in range(new):
        along = 0.0
        for k in range(s.counts[PLACES]):
            along += h[k] * u[term, places[k]]
        along *= s.signs[term]
        for column in range(columns):
            u[new, column] += along * u[term, column]
    return new


@borrowing_kernel
def along_h(s: JointArrays, term: int) -> float:
    """The product of h and a term."""
    total = 0.0
    for k in range(s.counts[PLACES]):
        total += s.h[k] * s.terms[term, s.h_places[k]]
    return total


@borrowing_kernel
def along_x(s: JointArrays) -> float:
    """The product of h and the state."""
    total = 0.0
    for k in range(s.counts[PLACES]):
        total += s.h[k] * s.x[s.h_places[k]]
    return total


@borrowing_kernel
def take(s: JointArrays, term: int, innovation: float, spread: float, own: int) -> None:
    """Kalman update with gain (P·h)/spread, P·h being the newest term, which then counts.

    ``own`` is the slot that the tag heard, −1 for a reception of others.
    """
    x, u, columns = s.x, s.terms, width(s)
    scale = 1.0 / np.sqrt(spread)
    step = innovation * scale
    for column in range(columns):
        u[term, column] *= scale
    for column in range(columns):
        x[column] += step * u[term, column]
    follow_faults(s, term, own, innovation, spread)
    s.counts[TERMS] = term + 1


@borrowing_kernel
def settle(s: JointArrays) -> None:
    """Add all terms to the covariance."""
    P, u, signs, n, columns = s.P, s.terms, s.signs, states(s), width(s)
    count = s.counts[TERMS]
    fours = count // 4 * 4
    for k in range(0, fours, 4):
        for row in range(n):
            a, b = signs[k] * u[k, row], signs[k + 1] * u[k + 1, row]
            c, d = signs[k + 2] * u[k + 2, row], signs[k + 3] * u[k + 3, row]
            for column in range(columns):
                P[row, column] += a * u[k, column] + b * u[k + 1, column] + c * u[k + 2, column] + d * u[k + 3, column]
    for k in range(fours, count):
        for row in range(n):
            a = signs[k] * u[k, row]
            for column in range(columns):
                P[row, column] += a * u[k, column]
    s.counts[TERMS] = 0
