"""The network of a run as GraphML, with what its links carried."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.network.graphs import Link
from netkf.runs.files import output_file, require_trace, this_process, write_atomically
from netkf.trace.messages import DELIVERED, LATE, LOST, by_link, join_messages
from netkf.trace.run import Run

if TYPE_CHECKING:
    import networkx

COUNTED = {"delivered": DELIVERED, "lost": LOST, "late": LATE}
NO_MESSAGES = {"sent": 0, **dict.fromkeys(COUNTED, 0)}


def export_graphml(run: Run, out: str | Path) -> tuple[Path, ...]:
    """Write the network of a run, ``carried_network``, as a GraphML file and return its path:
    ``out`` or, if that is a folder, ``out``/network.graphml.

    Raises ScenarioError for a run without a scenario, and WriteError.
    """
    import networkx

    graph = carried_network(run)
    path = output_file(out, "network.graphml")
    with write_atomically(path, this_process()) as temporary:
        networkx.write_graphml(graph, temporary)
    return (path,)


def carried_network(run: Run) -> networkx.Graph[Any]:
    """Return the network of a run as a networkx graph of ids, or names.

    Nodes have ``sensors`` (their number) and, if they stay, ``x`` and ``y``; links numbers of
    messages ``sent``, ``delivered``, ``lost`` and ``late``, their ``mean_age`` (s), and maybe
    ``delivery_probability``. Undirected ones have those of the other direction as ``sent_back`` and
    so on, unless a table tells directions apart. Links that follow positions are there if they
    carried.
    """
    import networkx

    scenario = require_trace(run)
    topology, delivery = scenario.topology, scenario.topology.delivery or {}
    one_way = topology.directed or any(p != delivery.get((j, i)) for (i, j), p in delivery.items())
    carried: dict[Link, dict[str, Any]] = {}
    for messages in by_link(join_messages(run.log)):
        counts: dict[str, Any] = {"sent": len(messages)}
        for name, outcome in COUNTED.items():
            counts[name] = int((messages["outcome"] == outcome).sum())
        ages = messages["age"][np.isfinite(messages["age"])]
        counts |= {"mean_age": float(ages.mean())} if len(ages) else {}
        carried[int(messages["sender"][0]), int(messages["receiver"][0])] = counts
    graph: networkx.Graph[Any] = networkx.DiGraph() if one_way else networkx.Graph()
    labels = {node: str(node) for node in scenario.nodes}
    for node, label in labels.items():
        place = (topology.positions or {}).get(node)
        xy = {} if place is None else {"x": float(place[0]), "y": float(place[1])}
        graph.add_node(label, sensors=len(scenario.placed_sensors.get(node, ())), **xy)
    for link in topology.directions if one_way else topology.links:
        if topology.radius is not None and not {link, link[::-1]} & carried.keys():
            continue
        attributes = dict(carried.get(link, NO_MESSAGES))
        if not one_way:
            back = carried.get(link[::-1], NO_MESSAGES)
            attributes |= {f"{name}_back": value for name, value in back.items()}
        if link in delivery:
            attributes["delivery_probability"] = float(delivery[link])
        graph.add_edge(labels[link[0]], labels[link[1]], **attributes)
    return graph
