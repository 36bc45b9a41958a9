"""Values of recorded tables that are no numbers, or no numbers to compute with."""

import pytest

import netkf
from netkf.scenario.reading import from_table

TABLES = {
    "readings.csv": ("t,node,y0,phi0", "1,0,1,1"),
    "states.csv": ("t,x0", "\n".join(f"{k},1" for k in range(7))),
    "slots.csv": ("slot,node,peer", "1,0,1"),
    "ticks.csv": ("t,node,peer", "1,0,1"),
    "lost.csv": ("sender,receiver,message,delivered", "0,1,0,1"),
    "delays.csv": ("sender,receiver,message,seconds", "0,1,0,0.5"),
    "times.csv": ("t,node", "1,0"),
    "links.csv": ("sender,receiver,delivery_probability", "0,1,0.5"),
    "places.csv": ("node,x,y", "0,0,0\n1,1,1"),
}


def scenario(folder, changes):
    """Names every table; half of them in continuous time."""
    for name, (header, rows) in TABLES.items():
        (folder / name).write_text(f"{header}\n{changes.get(name, rows)}\n")
    common = {"format": 1, "name": "tables", "horizon": 5.0, "probe": 1.0}
    graph = {"kind": "csv", "path": "links.csv", "positions": "places.csv"}
    recorded = {"kind": "recorded", "nodes": [0], "path": "readings.csv", "R": [[1.0]]}
    slots = {
        "plant": {
            "kind": "recorded",
            "path": "states.csv",
            "F": [[0.9]],
            "Q": [[1.0]],
            "period": 1.0,
        },
        "sensors": [recorded],
        "network": {
            "graph": graph,
            "activation": {"kind": "recorded", "path": "slots.csv"},
            "channel": {"loss": {"kind": "recorded", "path": "lost.csv"}},
        },
        "filter": {"kind": "gossip"},
    }
    sampling = {"kind": "recorded", "path": "times.csv"}
    clocks = {
        "plant": {"kind": "diffusion", "A": [[-0.5]], "B": [[1.0]]},
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]], "sampling": sampling}],
        "network": {
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "recorded", "path": "ticks.csv"},
            "channel": {"delay": {"kind": "recorded", "path": "delays.csv"}},
        },
        "filter": {"kind": "hybrid", "epsilon": 0.5},
    }
    for tables in (slots, clocks):
        from_table({**common, **tables}, folder)


def test_the_tables_are_right(tmp_path):
    scenario(tmp_path, {})


@pytest.mark.one_in(3)
@pytest.mark.parametrize("value", ["nan", "-nan", "inf", "-Infinity", "1e400", "", "x", "1e31"])
@pytest.mark.parametrize("name", TABLES)
def test_every_column_of_every_table_refuses_what_is_no_number(tmp_path, name, value):
    header, rows = TABLES[name]
    first, *others = rows.splitlines()
    entries = first.split(",")
    for k, column in enumerate(header.split(",")):
        if (name, column) == ("readings.csv", "y0") and value in ("", "nan"):
            continue  # the reading is missing
        if (
            name in ("links.csv", "places.csv")
            and column[0] in "srn"
            and value in ("x", "1e31", "1e400")
        ):
            continue  # a name, or an address
        row = ",".join([*entries[:k], value, *entries[k + 1 :]])
        with pytest.raises(netkf.ScenarioError) as refused:
            scenario(tmp_path, {name: "\n".join([row, *others])})
        line = str(refused.value)
        assert f"{name} line 2" in line
        assert column in line
        assert line.isprintable()
        if column == "y0" and value != "1e31":
            assert "leave it empty if it is missing" in line
