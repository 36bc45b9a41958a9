"""A scenario: everything that determines a run, checked as a whole when it is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from netkf.algorithms.kernels.maps import METHODS
from netkf.core.errors import ScenarioError
from netkf.scenario.block_sensors import unheard_notes
from netkf.scenario.checks import check_scenario
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.plugins import explained
from netkf.scenario.records import record_notes
from netkf.scenario.sampling import sampling_notes
from netkf.scenario.tables import change_keys
from netkf.scenario.time_grid import grid_notes, stamp_notes
from netkf.scenario.usage import repeat_notes


def _class_error(rule: str) -> ScenarioError:
    return ScenarioError("", rule, None, "correct the class or its settings")


@dataclass(frozen=True, eq=False, repr=False)
class Scenario(DerivedScenario):
    """Everything that determines a run.

    name     one line of text; it names the run directory
    horizon  simulated seconds; a run covers [0, horizon)
    plant    the dynamics of the state
    plants   in place of ``plant``: blocks of the state, each shared by all nodes or owned by one
    sensors  the sensors and the nodes that have them; nodes without a sensor only relay
    network  the graph, the activation of its links, and the channel of its messages
    filter   the filter that every node runs
    probe    period of the state samples in seconds, or increasing times in [0, horizon]
    claim    what the scenario shows, one line
    seed     root seed of all random numbers
    time     what the stamps of recorded tables mean, ``[time]``
    metrics  what summaries say beside means over time, ``[metrics]``

    All fields are checked on construction, alone and against each other; ScenarioError names the
    first mistake in one line.
    """

    def __post_init__(self) -> None:
        with explained(self, _class_error):
            super().__post_init__()
            check_scenario(self)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields and the topology, whose file may not exist where this is loaded."""
        names = {field.name for field in dataclasses.fields(self)}
        names |= {"_folder", "_trust", "topology", "time_grid"}
        return {name: value for name, value in self.__dict__.items() if name in names}

    def __repr__(self) -> str:
        kinds = (type(self.plant), type(self.network.graph), type(self.filter.algorithm))
        plant, graph, algorithm = (kind.__name__ for kind in kinds)
        return (
            f"<netkf.Scenario {self.name!r}: {plant} of {self.plant.n} states, {graph} of "
            f"{len(self.nodes)} nodes and {len(self.topology.links)} links, "
            f"{len(self.sensing_nodes)} with sensors, {algorithm} filters, {self.horizon:g} s, "
            f"seed {self.seed}>"
        )

    def replace(self, changes: Mapping[str, Any]) -> Scenario:
        """Return the scenario with some keys changed, e.g. ``{"network.activation.rate": 5.0}``.

        Keys are paths as in a scenario file; entries of a list are numbered, ``sensors.0.R``. A
        table may be given as a part, ``{"filter": netkf.parts.Hybrid(0.3)}``; it replaces the whole
        table, so that ``mean`` and ``cov`` of the filter are the plant's again.
        Raises ScenarioError for a key that does not exist or a value that breaks a rule.
        """
        return change_keys(self, changes)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user before a run, one line each, such as unused rows of a table."""
        make = self.node_filter.needs.notes
        with explained(self, _class_error):
            notes = () if make is None else tuple(make(self))
        return (
            *self.topology.notes,
            *notes,
            *repeat_notes(self),
            *record_notes(self),
            *sampling_notes(self),
            *unheard_notes(self),
            *stamp_notes(self),
            *grid_notes(self),
            *self._unused_notes,
        )

    @property
    def _unused_notes(self) -> tuple[str, ...]:
        notes = []
        if self.network.channel.loss.fate_share != 0.0 and not self.has_broadcasts:
            notes.append(
                "network.channel.loss: no fate is shared, because each transmission has one "
                'hearer; broadcasts are those of activation.at = "nodes", or of slots'
            )
        for key, plant in dict(self.all_plants).items():
            late = [c.start for c in getattr(plant, "schedule", ()) if c.start >= self.horizon]
            if late:
                entries = "1 entry is" if len(late) == 1 else f"{len(late)} entries are"
                notes.append(
                    f"{key}.schedule: {entries} never used, from {late[0]:g} s on, because the "
                    f"horizon is {self.horizon:g}"
                )
        parts = self.plant, *self.sensors
        if self.filter.linearise != METHODS[0] and all(part.linear for part in parts):
            kept = f'linearise = "{self.filter.linearise}"'
            notes.append(
                f"filter.linearise: {kept} changes nothing, because plant and sensors are linear"
            )
        return tuple(notes)
