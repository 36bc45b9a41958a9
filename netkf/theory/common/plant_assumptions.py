"""Assumptions that several papers share: the plant in slots, and the filters' first covariances."""

from __future__ import annotations

from collections import Counter

import numpy as np

from netkf.core.printable import count_phrase
from netkf.linalg.arrays import FloatArray, is_definite
from netkf.runs.labels import START_MARGIN
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow, judge_plant, true_model_row
from netkf.theory.intermittent.riccati import undetectable_slot_mode
from netkf.theory.numerics.matrices import unobservable_mode


def connected_row(scenario: Scenario, source: str) -> AssumptionRow:
    """Return the row that the graph is undirected and connected, by ``source``."""
    topology, parts = scenario.topology, len(scenario.topology.components)
    counts = {"node": len(topology.nodes), "link": len(topology.links), "part": parts}
    evidence = ", ".join(count_phrase(count, what) for what, count in counts.items())
    evidence += ", directed" if topology.directed else ""
    holds = parts == 1 and not topology.directed
    return "the graph is undirected and connected", source, holds, evidence


def judge_driven(F: FloatArray, Q: FloatArray, note: str = "") -> tuple[bool, str]:
    """Return whether the noise Q (n, n) drives every mode of F (n, n), and why; or a ``note``."""
    # (F, Q^1/2) is controllable if and only if (F', Q) is observable.
    idle = unobservable_mode(F.T, Q)
    if idle is None:
        return True, "every mode is driven by the noise"
    return False, f"the mode with eigenvalue {idle:.6g} is not driven{note}"


def judge_observed(scenario: Scenario, F: FloatArray, note: str = "") -> tuple[bool, str]:
    """Return whether all sensors together see every mode of F (n, n), and why; or a ``note``."""
    informations = list(scenario.informations)
    # (F, H) is observable if and only if (F, sum H' R^-1 H) is: both hide the same modes.
    hidden = unobservable_mode(F, np.sum(informations, axis=0))
    if hidden is not None:
        return False, f"the mode with eigenvalue {hidden:.6g} is not seen{note}"
    # Thousands of nodes may have equal sensors.
    counts, distinct = Counter(G.tobytes() for G in informations), {}
    for G in informations:
        distinct[G.tobytes()] = G
    observing = sum(counts[k] for k, G in distinct.items() if unobservable_mode(F, G) is None)
    return True, f"every mode is seen; {observing} of {len(informations)} nodes see all alone"


def slot_plant_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the rows that papers about slots share: stabilisable, Q definite, model known."""
    plant = scenario.linear_plant
    smallest = float(np.linalg.eigvalsh(plant.Q)[0])
    # (F, Q^1/2) is stabilisable if and only if (F', Q^1/2) is detectable.
    idle = undetectable_slot_mode(plant.F.T, plant.Q)
    evidence = "every mode that does not decay is driven by the noise"
    if idle is not None:
        evidence = f"the mode with eigenvalue {idle:.6g} is not driven"
    positive = f"least eigenvalue {smallest:.3g}; sufficient for the uniqueness of the limit law"
    return [
        (
            "(F, Q^1/2) is stabilisable",
            "G S.1, R Theorem 9",
            *judge_plant(scenario, idle is None, evidence),
        ),
        (
            "Q is positive definite",
            "G II-A, R Theorem 9",
            *judge_plant(scenario, bool(is_definite(plant.Q)), positive),
        ),
        true_model_row(scenario, "G (10), R (15)", "same F, Q and R"),
    ]


def start_rows(scenario: Scenario, source: str) -> list[AssumptionRow]:
    """Return the row, by ``source``, that P_i(0) is at least the second moment of the error."""
    smallest = scenario.start_margin
    return [
        (
            "P_i(0) >= E[(x(0) - xhat_i(0))(x(0) - xhat_i(0))']",
            source,
            *judge_plant(
                scenario,
                smallest >= START_MARGIN,
                f"least eigenvalue of the difference {smallest:.3g}",
            ),
        )
    ]


def model_and_start_rows(
    scenario: Scenario, source: str, *between: AssumptionRow
) -> list[AssumptionRow]:
    """Return the rows, by ``source``: the model, those ``between``, and the first covariances."""
    return [
        true_model_row(scenario, source, "same F, Q and R"),
        *between,
        *start_rows(scenario, source),
    ]
