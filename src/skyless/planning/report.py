"""The report of a plan: everything that it found, as one tree of plain values."""

from typing import Any

import msgspec

from skyless.planning.advice import plan_warnings
from skyless.planning.floor import Floor, Mounts
from skyless.planning.links import range_of
from skyless.planning.maps import MapSummary, PlanMap
from skyless.planning.optimise import Optimised, Scored, one_more
from skyless.planning.predict import Predictor
from skyless.planning.verify import Verification
from skyless.site.slots import schedule_of


def plan_report(
    predictor: Predictor,
    floor: Floor,
    mounts: Mounts,
    mapped: PlanMap,
    summary: MapSummary,
    optimised: Optimised | None,
    checked: Verification | None,
) -> dict[str, Any]:
    """The whole report, SI units."""
    site, settings = predictor.site, predictor.settings
    heights = tuple(mapped.grid.heights_m.tolist())
    more = one_more(site, settings, floor, mounts, heights) if len(site.anchors) < 200 else None
    return {
        "site": site.name,
        "method": settings.method,
        "tx_stamp_ps": site.noise.tx_stamp_ps,
        "rx_stamp_ps": site.noise.rx_stamp_ps,
        "qa": settings.qa,
        "range_m": range_of(settings.channel),
        "superframe_s": 1.0 / schedule_of(site).superframe_rate_hz,
        "master": site.master,
        "dimensions": 3 if site.tags.height_m is None else 2,
        "heights_m": heights,
        "region_m": floor.region_m,
        "outline_m": floor.outline_m,
        "step_m": mapped.grid.step_m,
        "computed_every_m": mapped.computed_every_m,
        **msgspec.to_builtins(summary),
        "walls_bias": mapped.has_bias,
        "anchors": [
            {
                "id": anchor.id,
                "x_m": anchor.x_m,
                "y_m": anchor.y_m,
                "z_m": anchor.z_m,
                "hears_master": float(predictor.links.share[row]),
                "sends": bool(predictor.clocks.sends[row]),
            }
            for row, anchor in enumerate(site.anchors)
        ],
        "warnings": plan_warnings(predictor, floor, mapped),
        "one_more": more,
        "optimised": None if optimised is None else _optimised(optimised),
        "verification": checked,
    }


def _optimised(found: Optimised) -> dict[str, Any]:
    return {
        "best": _scored(found.best),
        "even": _scored(found.even),
        "mean_ratio": found.best.mean_sigma_m / found.even.mean_sigma_m,
        "worst_ratio": found.best.worst_sigma_m / found.even.worst_sigma_m,
        "target_met": found.target_met,
        "evaluations": found.evaluations,
        "finished": found.finished,
    }


def _scored(scored: Scored) -> dict[str, Any]:
    return {
        "mean_sigma_m": scored.mean_sigma_m,
        "worst_sigma_m": scored.worst_sigma_m,
        "covered_share": scored.covered_share,
        "master": scored.site.master,
        "anchors": [(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in scored.site.anchors],
    }


def described(result: dict[str, Any]) -> str:
    """Method, noise and schedule in one line."""
    tx_ps, rx_ps = result["tx_stamp_ps"], result["rx_stamp_ps"]
    noise = f"{tx_ps:g} ps" if tx_ps == rx_ps else f"{tx_ps:g} ps (TX) and {rx_ps:g} ps (RX)"
    process_noise = f" with qa {result['qa']:g} m²/s³" if result["method"] == "joint" else ""
    return (
        f"predicted for {result['method']}{process_noise}, stamps of {noise}, "
        f"superframes of {1e3 * result['superframe_s']:.1f} ms, tags at rest"
    )
