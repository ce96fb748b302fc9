"""The paper's variances derived again: its algorithm run on symbols, linearised, and compared term by term.

The functions that are linearised are the program's own (``positioning/methods/snapshots.py``), fed with clock readings
plus noise. Nothing of ``CORRECTED`` or of the errata enters before the comparison.
"""

import pytest
import sympy as sp

from skyless.core.protocol1 import snapshots
from skyless.research import uncertainty
from skyless.research.uncertainty import CORRECTED, PRINTED, Chain

pytestmark = pytest.mark.statistical

POSITIVE = [
    "master_rate",
    "tag_rate",
    "anchor_rate",
    "anchor_tof_s",
    "tag_tof_s",
    "tag_master_tof_s",
    "sync_spacing_s",
    "spacing_s",
    "sigma_master_s",
    "sigma_anchor_s",
    "sigma_tag_s",
]
REAL = ["master_offset_s", "tag_offset_s", "anchor_offset_s", "sync_s", "reference_s", "delay_s"]
CHAIN = Chain(
    **{name: sp.Symbol(name, positive=True) for name in POSITIVE}, **{name: sp.Symbol(name, real=True) for name in REAL}
)
Q = (1 + CHAIN.kappa) ** 2 + CHAIN.kappa**2
U = CHAIN.master_offset_s + CHAIN.master_rate * CHAIN.reference_s - CHAIN.T_c
"""What ``docs/maths.md`` section 2 calls Q and u."""
MASTER, ANCHOR, TAG = CHAIN.sigma_master_s, CHAIN.sigma_anchor_s, CHAIN.sigma_tag_s
M1, M2, REF, S1, S2, A1, A2, R1, R2, RM = STAMPS = sp.symbols("m1 m2 tm s1 s2 a1 a2 r1 r2 rm", real=True)
"""Noise of each stamp: the master's, the anchor's receptions and transmissions, the tag's receptions."""
SIGMAS = dict(zip(STAMPS, [MASTER] * 3 + [ANCHOR] * 4 + [TAG] * 3, strict=True))
LIGHT = sp.Symbol("c", positive=True)
QUANTITIES = (
    "beta",
    "gamma_first",
    "gamma_delayed",
    "gamma_averaged",
    "epsilon_first",
    "epsilon_delayed",
    "xi",
    "phi",
    "lambda_m2",
)


@pytest.fixture(autouse=True)
def light_is_a_symbol(monkeypatch):
    """The speed of light as a float is not exact when squared."""
    monkeypatch.setattr(uncertainty, "SPEED_OF_LIGHT_MPS", LIGHT)


def algorithm(same_as=None):
    """Every quantity of the chain from noisy stamps; ``same_as``: the sync stamp that is also the reference's."""
    c = CHAIN
    reference = {None: REF, M1: M1, M2: M2}[same_as]
    t_m = {None: c.reference_s, M1: c.sync_s, M2: c.sync_s + c.sync_spacing_s}[same_as]

    def master(t, noise):
        return c.master_offset_s + c.master_rate * t + noise

    def anchor(t, noise):
        return c.anchor_offset_s + c.anchor_rate * t + noise

    def tag(t, noise):
        return c.tag_offset_s + c.tag_rate * t + noise

    t1, t2, t_i = c.sync_s, c.sync_s + c.sync_spacing_s, t_m + c.delay_s
    m1, m2 = master(t1, M1), master(t2, M2)
    s1, s2 = anchor(t1 + c.anchor_tof_s, S1), anchor(t2 + c.anchor_tof_s, S2)
    a1, a2 = anchor(t_i, A1), anchor(t_i + c.spacing_s, A2)
    r1, r2 = tag(t_i + c.tag_tof_s, R1), tag(t_i + c.spacing_s + c.tag_tof_s, R2)
    rate = snapshots.relative_rate(s2 - s1, m2 - m1)
    first = snapshots.relative_offset(s1, m1, rate, c.anchor_tof_s)
    delayed = snapshots.relative_offset(s2, m2, rate, c.anchor_tof_s)
    offset = snapshots.averaged_offset(first, delayed)
    x1, x2 = snapshots.to_master(a1, rate, offset), snapshots.to_master(a2, rate, offset)
    tags_rate = snapshots.tag_rate(r2 - r1, x2 - x1)
    interval = snapshots.protocol_interval(tags_rate, x1, master(t_m, reference))
    tdoa = (r1 - tag(t_m + c.tag_master_tof_s, RM)) - interval
    return {
        "beta": rate,
        "gamma_first": first,
        "gamma_delayed": delayed,
        "gamma_averaged": offset,
        "epsilon_first": x1,
        "epsilon_delayed": x2,
        "xi": tags_rate,
        "phi": interval,
        "lambda_m2": LIGHT * tdoa,
    }


QUIET = dict.fromkeys(STAMPS, 0)


def gradient(expression):
    """Sensitivity to the noise of each stamp, at no noise."""
    return {stamp: sp.simplify(sp.diff(expression, stamp).subs(QUIET)) for stamp in STAMPS}


def covariance(first, second):
    return sum(first[stamp] * second[stamp] * SIGMAS[stamp] ** 2 for stamp in STAMPS)


@pytest.fixture(scope="module")
def gradients():
    return {name: gradient(value) for name, value in algorithm().items()}


def equal(a, b):
    return sp.simplify(sp.nsimplify(a - b, rational=True)) == 0


@pytest.mark.parametrize("name", QUANTITIES)
@pytest.mark.statistical
def test_the_corrected_variances_are_those_of_the_algorithm(gradients, name):
    assert equal(covariance(gradients[name], gradients[name]), getattr(CORRECTED, name)(CHAIN))


def test_the_corrected_autocovariance_of_epsilon_is_that_of_the_algorithm(gradients):
    derived = covariance(gradients["epsilon_first"], gradients["epsilon_delayed"])
    assert equal(derived, CORRECTED.epsilon_covariance(CHAIN))


def test_the_compact_form_is_the_same_variance():
    """σ_λ² free of the origin of time: what of which stamp remains (``docs/maths.md`` section 2)."""
    c = CHAIN
    tag = (Q + 1) * TAG**2 + c.V**2 * MASTER**2
    anchor = (Q + sp.Rational(1, 2)) * ANCHOR**2 + c.N**2 * MASTER**2 / 2
    compact = LIGHT**2 * (tag + (c.V / c.N) ** 2 * (anchor + U**2 * CORRECTED.beta(c)))
    assert equal(compact, CORRECTED.lambda_m2(c))


def test_both_offsets_are_one_for_any_noise():
    """Erratum E2, without linearising anything."""
    values = algorithm()
    assert sp.simplify(values["gamma_first"] - values["gamma_delayed"]) == 0


def test_without_noise_the_chain_gives_what_the_paper_says():
    """``eq:AnchorSync`` with e_{i,m}, ``eq:TagSynchro``, ``eq:GPSTDoA``."""
    c = CHAIN
    values = {name: value.subs(QUIET) for name, value in algorithm().items()}
    assert equal(values["beta"], c.N)
    assert equal(values["epsilon_first"], c.X1)
    assert equal(values["epsilon_delayed"], c.X2)
    assert equal(values["xi"], c.V)
    difference = c.tag_rate * (c.tag_tof_s - c.tag_master_tof_s) - c.V * c.e
    assert equal(values["lambda_m2"], LIGHT * difference)


def test_what_is_wrong_in_the_printed_variances():
    """The difference printed − derived of every quantity that owes nothing to another one."""
    c = CHAIN
    s_i, s_m, beta = ANCHOR**2, MASTER**2, CORRECTED.beta(CHAIN)

    def excess(name):
        return getattr(PRINTED, name)(c) - getattr(CORRECTED, name)(c)

    assert equal(excess("beta"), 0)
    assert equal(excess("gamma_first"), -4 * c.T / c.L * s_i)  # E1
    averaged = s_m / 2 * (1 - c.N**2)
    assert equal(excess("gamma_averaged"), averaged)  # E3
    for name, reading in (("epsilon_first", c.X1), ("epsilon_delayed", c.X2)):  # E4, with what E3 leaves
        assert equal(excess(name), (averaged + reading * c.L * beta) / c.N**2)
    assert equal(excess("epsilon_covariance"), (averaged - c.X1 * c.e * beta) / c.N**2)  # E5, with what E3 leaves
    assert equal(excess("xi"), 0)
    phi = c.V**2 * excess("epsilon_first")
    phi += 2 * c.V**2 * c.kappa * (excess("epsilon_first") - excess("epsilon_covariance"))
    assert equal(excess("phi"), phi)
    assert equal(excess("lambda_m2"), LIGHT**2 * phi)


@pytest.mark.parametrize("packet", [M1, M2])
@pytest.mark.statistical
def test_a_reference_among_the_sync_packets_takes_the_master_out(packet):
    """Then neither its noise nor the rate error is left, and the spacing D does not matter (MATHS section 2)."""
    c = CHAIN
    tdoa = gradient(algorithm(same_as=packet)["lambda_m2"])
    assert all(tdoa[stamp] == 0 for stamp in (M1, M2, REF))
    at = {c.reference_s: c.sync_s if packet is M1 else c.sync_s + c.sync_spacing_s}
    q = Q.subs(at)
    expected = LIGHT**2 * ((q + 1) * TAG**2 + (c.V / c.N) ** 2 * (q + 1) * ANCHOR**2)
    assert equal(covariance(tdoa, tdoa), expected)


@pytest.mark.parametrize(("packet", "masters"), [(None, "1 + w1**2 + w2**2"), (M1, "0"), (M2, "0")])
@pytest.mark.statistical
def test_what_two_anchors_have_in_common(packet, masters):
    """Two anchors share the master's stamps and the tag's reference stamp; all else is their own."""
    c = CHAIN
    tdoa = gradient(algorithm(same_as=packet)["lambda_m2"])
    shared = [M1, M2, REF, RM]
    own_names = {c.anchor_rate: "other_rate", c.delay_s: "other_delay", c.spacing_s: "other_spacing"}
    rename = {old: sp.Symbol(new, positive=True) for old, new in own_names.items()}
    common = sum(tdoa[stamp] * tdoa[stamp].subs(rename) * SIGMAS[stamp] ** 2 for stamp in shared)
    at = {None: c.reference_s, M1: c.sync_s, M2: c.sync_s + c.sync_spacing_s}[packet]
    u = U.subs(c.reference_s, at)
    mu = sp.sympify(masters, locals={"w1": sp.Rational(1, 2) - u / c.L, "w2": sp.Rational(1, 2) + u / c.L})
    assert equal(common, LIGHT**2 * (TAG**2 + c.V**2 * MASTER**2 * mu))
