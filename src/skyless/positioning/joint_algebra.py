"""The algebra of ``joint``: sparse measurements, and a covariance that changes by terms −u·uᵀ.

Terms are collected while a packet is taken and added to the covariance in one go; until then whoever asks for a product
P·h gets theirs as well. The noise of passing time has few distinct figures and waits even longer, until the base of the
values moves. As u_i·u_j = u_j·u_i to the bit, the covariance stays symmetric to the bit.

What a fault does to the states (``protection_updates``) is a column beside the covariance and goes the same way: the
product with h stands beside P·h, and each term has its responses beside u.
"""

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.eights import EIGHT, add, load, repeated, scaled, store
from skyless.positioning.joint_state import (
    CLOCK_CROSS,
    CLOCK_RATE,
    CLOCK_VALUE,
    DIM,
    MOST_TERMS,
    MOTION_CROSS,
    MOTION_RATE,
    MOTION_VALUE,
    PLACES,
    SLOTS,
    TERMS,
    JointArrays,
    Matrix,
    lanes,
    states,
    values,
    width,
)
from skyless.positioning.protection_updates import gather_evidence


@borrowing_kernel
def put(s: JointArrays, place: int, value: float) -> None:
    """Set one more element of the measurement."""
    count = s.counts[PLACES]
    s.h_places[count] = place
    s.h[count] = value
    s.counts[PLACES] = count + 1


@borrowing_kernel
def project(s: JointArrays) -> int:
    """Write P·h of the measurement to a new term, not yet counted among the terms; returns its place."""
    if s.counts[TERMS] == MOST_TERMS:
        add_terms(s)
    new: int = s.counts[TERMS]
    for term in range(new):
        s.along[term] = along_h(s, term)
    _combine(s, s.P, s.terms, new, width(s))
    _combine(s, s.sensitivities, s.responses, new, lanes(s))
    _project_noise(s, s.terms, new)
    return new


@borrowing_kernel
def _combine(s: JointArrays, matrix: Matrix, terms: Matrix, new: int, columns: int) -> None:
    """The combination of the matrix's rows that the measurement makes, as the terms have changed them."""
    h, places, along, count = s.h, s.h_places, s.along, s.counts[PLACES]
    for column in range(0, columns, EIGHT):
        total = scaled(h[0], load(matrix, (places[0], column)))
        for k in range(1, count):
            total = add(total, h[k], load(matrix, (places[k], column)))
        for term in range(new):
            total = add(total, -along[term], load(terms, (term, column)))
        store(terms, (new, column), total)


@borrowing_kernel
def _project_noise(s: JointArrays, u: Matrix, new: int) -> None:
    """Add to a product with h what passing time has brought."""
    noise, dim, half = s.noise, int(s.settings[DIM]), values(s)
    offset = rate = 0.0
    for k in range(s.counts[PLACES]):
        place, h = s.h_places[k], s.h[k]
        if place < half:
            motion = place < dim
            u[new, place] += h * noise[MOTION_VALUE if motion else CLOCK_VALUE]
            u[new, half + place] += h * noise[MOTION_CROSS if motion else CLOCK_CROSS]
            offset += 0.0 if motion else h
        elif place < 2 * half:
            motion = place < half + dim
            u[new, place - half] += h * noise[MOTION_CROSS if motion else CLOCK_CROSS]
            u[new, place] += h * noise[MOTION_RATE if motion else CLOCK_RATE]
            rate += 0.0 if motion else h
    if offset != 0.0 or rate != 0.0:
        value = offset * noise[CLOCK_VALUE] + rate * noise[CLOCK_CROSS]
        change = offset * noise[CLOCK_CROSS] + rate * noise[CLOCK_RATE]
        for place in range(dim, half):
            u[new, place] += value
            u[new, half + place] += change


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
    x, u = s.x, s.terms
    scale = 1.0 / np.sqrt(spread)
    step = innovation * scale
    for column in range(0, width(s), EIGHT):
        one = scaled(scale, load(u, (term, column)))
        store(u, (term, column), one)
        store(x, column, add(load(x, column), step, one))
    gather_evidence(s, term, own, step, scale)
    s.counts[TERMS] = term + 1


@borrowing_kernel
def add_terms(s: JointArrays) -> None:
    """Add all terms to the covariance, to the sensitivities and to what slots share."""
    count, u, r = s.counts[TERMS], s.terms, s.responses
    for k in range(count, _in_terms(count)):  # terms of nothing
        for column in range(0, width(s), EIGHT):
            store(u, (k, column), repeated(0.0))
        for column in range(0, lanes(s), EIGHT):
            store(r, (k, column), repeated(0.0))
    k = 0
    while count - k > 2:
        _add_four(s.P, u, u, k, states(s), width(s))
        _add_four(s.sensitivities, u, r, k, states(s), lanes(s))
        _add_four(s.shared, r, r, k, s.counts[SLOTS], lanes(s))
        k += 4
    if k < count:
        _add_two(s.P, u, u, k, states(s), width(s))
        _add_two(s.sensitivities, u, r, k, states(s), lanes(s))
        _add_two(s.shared, r, r, k, s.counts[SLOTS], lanes(s))
    s.counts[TERMS] = 0


@borrowing_kernel
def _in_terms(count: int) -> int:
    """So many terms in whole fours, and two at the end where that is enough."""
    return (count + 1) // 4 * 4 + (2 if 0 < count % 4 < 3 else 0)


@borrowing_kernel
def _add_four(matrix: Matrix, u: Matrix, terms: Matrix, k: int, rows: int, columns: int) -> None:
    for column in range(0, columns, EIGHT):
        a, b = load(terms, (k, column)), load(terms, (k + 1, column))
        c, d = load(terms, (k + 2, column)), load(terms, (k + 3, column))
        for row in range(rows):
            total = add(add(load(matrix, (row, column)), -u[k, row], a), -u[k + 1, row], b)
            store(matrix, (row, column), add(add(total, -u[k + 2, row], c), -u[k + 3, row], d))


@borrowing_kernel
def _add_two(matrix: Matrix, u: Matrix, terms: Matrix, k: int, rows: int, columns: int) -> None:
    for column in range(0, columns, EIGHT):
        a, b = load(terms, (k, column)), load(terms, (k + 1, column))
        for row in range(rows):
            total = add(load(matrix, (row, column)), -u[k, row], a)
            store(matrix, (row, column), add(total, -u[k + 1, row], b))


@borrowing_kernel
def settle(s: JointArrays) -> None:
    """Bring the covariance up to date: all terms, and the noise of the time that has passed."""
    add_terms(s)
    P, noise, dim, half = s.P, s.noise, int(s.settings[DIM]), values(s)
    value, cross, rate = noise[CLOCK_VALUE], noise[CLOCK_CROSS], noise[CLOCK_RATE]
    for place in range(dim):
        _add_noise(P, place, half + place, noise[MOTION_VALUE], noise[MOTION_CROSS], noise[MOTION_RATE])
    for place in range(dim, half):
        _add_noise(P, place, half + place, value, cross, rate)
        for other in range(dim, half):  # the tag's own oscillator, which all offsets share
            P[place, other] += value
            P[place, half + other] += cross
            P[half + place, other] += cross
            P[half + place, half + other] += rate
    noise[:] = 0.0


@borrowing_kernel
def _add_noise(P: Matrix, place: int, rate_place: int, value: float, cross: float, rate: float) -> None:
    P[place, place] += value
    P[place, rate_place] += cross
    P[rate_place, place] += cross
    P[rate_place, rate_place] += rate
