"""The bound of the textbook: a Kalman filter of all that stamps and phases depend on, with dense matrices."""

import math

import numpy as np
from msgspec.structs import replace

from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.research.studies.efficiency import random_path
from skyless.research.uncertainty import OFFSET_STD_M, POSITION_STD_M, RATE_STD_MPS, Biases, BoundSettings

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
RAISED = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
SLOT_S = 2.5e-3
STAMP_S = 100e-12
USUAL = {"white_fm": 2e-11, "random_walk_fm": 1e-9, "qa": 0.5, "slot_s": SLOT_S, "speed_std_mps": 0.4, "mesh": True}
PHASES = {"phase_std_m": 0.002, "phase_wander": 1e-4}
ROOM = Biases(survey_std_m=0.02, constant_std_m=0.029, slope_std_m=0.05)
ALL_BIASES = replace(ROOM, changing_std_m=0.03, correlation_s=0.5, correlation_m=0.3)


def settings_of(stamp_s=STAMP_S, **changes):
    return BoundSettings(stamp_s, **(USUAL | changes))


def walk(superframes=40, height_m=0.0):
    middle_m, half_m = np.array([3.0, 4.0]), np.array([1.0, 1.0])
    path_m = random_path(np.random.default_rng(5), middle_m, half_m, SLOT_S, superframes * 6, 0.5)
    return np.add(path_m, [0.0, 0.0, height_m])


def textbook(anchors, path, settings, biases=Biases()):  # noqa: B008 - a frozen value
    """Covariance of position and velocity after each frame; all receptions of a frame are one update.

    The states are another set on purpose: here clocks run against true time, and every clock has its own offset and
    rate, the first anchor's too, whose prior is exact. TX noise is in the measurements' covariance, and a phase has
    none. States: [p, v, (offset, rate) of tag and anchors, ambiguities, of which 1 km stands for nothing known,
    surveys, constants, changes, slope].
    """
    n, dims = len(anchors), 2 if settings.height_known else 3
    sizes = {"p": dims, "v": dims, "tag": 2, "anchors": 2 * n, "phase": n, "survey": dims * n, "late": n, "change": n}
    at = dict(zip([*sizes, "slope"], np.cumsum([0, *sizes.values()]).tolist(), strict=True))
    clock = [OFFSET_STD_M, RATE_STD_MPS]
    stds = [POSITION_STD_M] * dims + [settings.speed_std_mps] * dims + clock + [0.0, 0.0] + clock * (n - 1)
    stds += [1e3] * n + [biases.survey_std_m] * (dims * n) + [biases.constant_std_m] * n + [biases.changing_std_m] * n
    P = np.diag(np.square([*stds, biases.slope_std_m]))
    white, clock_walk = (SPEED_OF_LIGHT_MPS**2 * fm**2 for fm in (settings.white_fm, settings.random_walk_fm))
    F, Q, dt = np.eye(len(P)), np.zeros_like(P), settings.slot_s
    motion = [(axis, dims + axis, 0.0, settings.qa) for axis in range(dims)]
    for value, rate, w, q in motion + [(i, i + 1, white, clock_walk) for i in range(at["tag"], at["phase"], 2)]:
        F[value, rate] = dt
        Q[np.ix_([value, rate], [value, rate])] = [[w * dt + q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]]
    changes, has_phases = np.arange(at["change"], at["slope"]), math.isfinite(settings.phase_std_m)
    way_m, found = np.zeros(n), []
    for frame, place in enumerate(path):
        sender = frame % n
        if frame:
            step_m = np.linalg.norm(place - path[frame - 1])
            kept = math.exp(-dt / biases.correlation_s - step_m / biases.correlation_m)
            F[changes, changes], Q[changes, changes] = kept, (1 - kept**2) * biases.changing_std_m**2
            P = F @ P @ F.T + Q
            way_m += step_m
        P[at["phase"] + sender, at["phase"] + sender] += settings.phase_wander * way_m[sender]
        way_m[sender] = 0.0

        def survey(anchor):
            return slice(at["survey"] + dims * anchor, at["survey"] + dims * (anchor + 1))

        own = 1 + has_phases
        listeners = [i for i in range(n) if i != sender and (settings.mesh or sender == 0)]
        H = np.zeros((own + len(listeners), len(P)))
        range_m = np.linalg.norm(place - anchors[sender])
        H[:own, :dims] = ((place - anchors[sender]) / range_m)[:dims]
        H[:own, survey(sender)] = -H[0, :dims]
        H[:own, [at["tag"], at["late"] + sender, at["change"] + sender]] = 1.0
        H[:own, at["slope"]] = np.clip((range_m - 4.0) / 4.0, -1.0, 1.0)
        H[1:own, at["phase"] + sender] = 1.0
        for row, listener in enumerate(listeners, start=own):
            between_m = (anchors[listener] - anchors[sender])[:dims]
            H[row, survey(listener)] = between_m / np.linalg.norm(anchors[listener] - anchors[sender])
            H[row, survey(sender)] = -H[row, survey(listener)]
            H[row, at["anchors"] + 2 * listener] = 1.0
        H[:, at["anchors"] + 2 * sender] -= 1.0
        tx = np.ones(len(H))
        tx[1:own] = 0.0
        R = (SPEED_OF_LIGHT_MPS * settings.stamp_s) ** 2 * (np.eye(len(H)) + np.outer(tx, tx))
        R[range(1, own), range(1, own)] = settings.phase_std_m**2
        P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        P = 0.5 * (P + P.T)
        found.append(P[: 2 * dims, : 2 * dims].copy())
    return np.array(found)


def positions(covariances, dims, anchors=6):
    """Of position alone, at the end of each superframe but the first two."""
    return covariances[anchors - 1 :: anchors, :dims, :dims][2:]
