"""The tables of docs/filters_compared.md: filters on the eight networks of scenarios/benchmark.

    python analysis/filters_compared.py [RUNS] > tables.md

All filters of a network meet the same truth, the same readings and the same draws. An entry is the
RMS error over that of the central filter, then NEES / n; a dash says that the filter cannot run
there. A second table has the bytes that all nodes send per second.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import netkf

FOLDER = Path(__file__).parent.parent / "scenarios" / "benchmark"
NETWORKS = (
    *("ring_lossless", "ring_loss", "grid_lossless", "grid_bursts"),
    *("geometric_loss", "geometric_bursts", "intel_lab", "one_way"),
)
UNSTABLE = 100.0
"""Times the error of the central filter beyond which errors grow for ever."""


def filters_of(scenario: netkf.Scenario) -> dict[str, object]:
    """Return the filters by the names that the table gives them."""
    degree = max(scenario.topology.degrees.values())
    # Just above the largest eigenvalue of the Laplacian: averaging contracts for any loss.
    delta = 1.01 * scenario.topology.laplacian_radius
    return {
        "central": "central",
        "HCMCI, 3 steps": {"kind": "hcmci", "steps": 3},
        "ICF, 1 step": {"kind": "icf", "steps": 1},
        "CI, 3 steps": {"kind": "hcmci", "consensus": "information", "steps": 3},
        "CI, 1 step": {"kind": "hcmci", "consensus": "information", "steps": 1},
        "CM, 3 steps": {"kind": "hcmci", "consensus": "measurements", "steps": 3},
        "KCF": {"kind": "kcf", "epsilon": 0.1},
        "diffusion Kalman": {"kind": "diffusion-kalman"},
        "diffusion": {"kind": "diffusion"},
        "push-sum, gamma 10": {
            **{"kind": "push-sum", "gamma": 10, "delta": delta, "running_sums": True},
            "leader": scenario.nodes[0],
        },
        "best CI": {"kind": "track-fusion", "rule": "ci"},
        "inverse CI": {"kind": "track-fusion", "rule": "ici"},
        "Bar-Shalom and Campo": {"kind": "track-fusion", "rule": "cross-covariance"},
        "event-triggered CI": {"kind": "event-triggered", "trigger": "consensus"},
        "stochastic trigger": {
            **{"kind": "event-triggered", "trigger": "stochastic", "Y": 1.0},
            "inner": {"kind": "intermittent"},
        },
        "belief propagation, 3 steps": {"kind": "belief-propagation", "steps": 3},
        "consensus + innovations": "consensus-innovations",
        "one-bit": "one-bit",
        "hybrid": {"kind": "hybrid", "epsilon": 1.0 / (1.0 + degree)},
        "intermittent": {"kind": "intermittent"},
        "local": "local",
    }


def main(arguments: Sequence[str] | None = None) -> list[Any]:
    """Run all comparisons and print both tables; return comparisons with their horizons (s)."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=int, nargs="?", default=100)
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=NETWORKS)
    parser.add_argument("--horizon", type=float, help="seconds (default: the scenarios')")
    options = parser.parse_args(arguments)
    changes = {} if options.horizon is None else {"horizon": options.horizon}
    names: list[str] = []
    found: list[Any] = []
    for network in options.networks:
        scenario = netkf.load(FOLDER / f"{network}.toml", changes)
        chosen = filters_of(scenario)
        names = list(chosen)
        runs = options.runs
        comparison = netkf.compare_filters(scenario, list(chosen.values()), runs, workers=1)
        found.append((comparison, scenario.horizon))
        print(network, file=sys.stderr, flush=True)
    header = f"| | {' | '.join(network.replace('_', ' ') for network in options.networks)} |"
    rule = "|---" * (1 + len(options.networks)) + "|"
    print(
        "\n".join([header, rule, *(_row(name, k, found, _quality) for k, name in enumerate(names))])
    )
    print()
    print(
        "\n".join([header, rule, *(_row(name, k, found, _traffic) for k, name in enumerate(names))])
    )
    return found


def _row(name: str, k: int, found: list[Any], cell: object) -> str:
    assert callable(cell)
    return f"| {name} | {' | '.join(cell(one, k) for one in found)} |"


def _quality(one: Any, k: int) -> str:
    found, _ = one
    row, central = found.rows[k], found.rows[0]
    if not row.ran:
        return "-"
    ratio = row.quantities["rms_error"].value / central.quantities["rms_error"].value
    nees = row.quantities["nees_ratio"].value
    if ratio > UNSTABLE or row.status != "complete":
        return "unstable"
    return f"{ratio:.2f} ({nees:.2f})"


def _traffic(one: Any, k: int) -> str:
    found, horizon = one
    row = found.rows[k]
    if not row.ran:
        return "-"
    rate = row.bytes / horizon
    return f"{rate:.2f}" if 0.0 < rate < 1.0 else f"{rate:,.0f}"


if __name__ == "__main__":
    main()
