"""Tables as people have them: separators, comments, compression, stamps and their origin."""

import gzip
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.core.csv_files import read_columns
from netkf.core.fields import SourceFile
from netkf.core.stamps import TimeBase

PLAIN = "t,node,y0\n1.0,0,0.3\n2.5,1,-0.7\n"
SECONDS = TimeBase()
DIALECTS = {
    "plain": PLAIN,
    "semicolons": PLAIN.replace(",", ";"),
    "of a spreadsheet": "sep=;\n" + PLAIN.replace(",", ";"),
    "decimal commas": "t;node;y0\n1,0;0;0,3\n2,5;1;-0,7\n",
    "tabs": PLAIN.replace(",", "\t"),
    "tabs and commas": "t\tnode\ty0\n1,0\t0\t0,3\n2,5\t1\t-0,7\n",
    "comments": "# log of lab 1\n" + PLAIN.replace("2.5", "# restart\n  # again, 7\n2.5") + "# end",
    "blank lines": "\n" + PLAIN.replace("\n", "\n\n") + ",,\n",
    "mark": "\ufeff" + PLAIN,
    "carriage returns": PLAIN.replace("\n", "\r\n"),
    "only carriage returns": PLAIN.replace("\n", "\r"),
    "quotes": '"t","node","y0"\n"1.0","0","0.3"\n2.5,1,-0.7\n',
    "spaces": PLAIN.replace(",", " , "),
    "other columns": "y0,name,node,t\n0.3,é,0,1.0\n-0.7,,1,2.5\n",
}


def columns(folder, text, stamps=SECONDS, required=("t", "node", "y0"), packed=False, **keys):
    data = text.encode()
    (folder / "table.csv").write_bytes(gzip.compress(data) if packed else data)
    return read_columns(SourceFile("table.csv", folder, stamps), required, **keys)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
def test_a_table_is_the_same_in_every_dialect(tmp_path, text, packed):
    table = columns(tmp_path, text, packed=packed)
    assert table["t"].tolist() == [1.0, 2.5]
    assert table["node"].tolist() == [0.0, 1.0]
    assert table["y0"].tolist() == [0.3, -0.7]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t;node;y0\n1,0;0;0,3\n2.5;0;0.3\n", "line 2 has ',' and line 3 has '.'"),
        ("# t,node,y0\n1.0,0,0.3\n", "remove the # before the names of the columns in line 1"),
        ("1.0,0,0.3\n", "write the names of the columns in the first line"),
        ("T,node,y0\n1.0,0,0.3\n", "write t for T"),
        ("t node y0\n1.0 0 0.3\n", "separate the columns by commas, semicolons or tabs"),
        ("t|node|y0\n1.0|0|0.3\n", "separate the columns by commas, semicolons or tabs"),
        ("", "write the names of the columns in the first line"),
        ("t,node,y0\n# a\n\n1,0,0,0,3\n", "line 4 must have 3 entries"),
        ("t,node,y0\n1,0,0,0,3\n", "with decimal commas separate columns by semicolons"),
        ('t,node,y0\n1,0,"0,3"\n', "write a decimal point"),
        ("t,node,y0,y0\n1,0,2,3\n", "must have one column y0"),
        ("# a\nt,node,y0\n1,0,2\n1,0.5,2\n", "line 4: node must hold integers"),
        ("t,node,y0\n2009-07-22T15:10:60Z,0,2\n", "or an ISO 8601 time"),
        ("t,node,y0\n1_0,0,2\n", "line 2: t must be a finite number"),
        ("t,node,y0\n1,0,1_0\n", "line 2: y0 must be a finite number"),
        ("PK\x03\x04\x00", "must have the columns"),
    ],
)
def test_a_refusal_names_what_is_seen_and_what_to_do(tmp_path, text, said):
    with pytest.raises(netkf.ScenarioError) as refused:
        columns(tmp_path, text).integers("node")
    assert said in str(refused.value)
    assert "leave" not in str(refused.value)
    assert "remove the row" not in str(refused.value)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (PLAIN.encode("utf-16"), "save it as UTF-8"),
        ("t,node,é\n".encode("latin-1"), "save it as UTF-8"),
        (gzip.compress(PLAIN.encode() * 99)[:-20], "correct the file"),
        (b"PK\x03\x04\xff\xfe", "save the table as CSV"),
        (
            gzip.compress(b"t,node,y0\n") + 300 * gzip.compress(b"0" * (1 << 20), 1),
            "at most 256 MiB",
        ),
    ],
    ids=["UTF-16", "latin-1", "cut", "spreadsheet", "bomb"],
)
def test_files_that_are_no_table_of_text(tmp_path, data, said):
    (tmp_path / "table.csv").write_bytes(data)
    with pytest.raises(netkf.ScenarioError) as refused:
        read_columns(SourceFile("table.csv", tmp_path), ("t",))
    assert said in str(refused.value)


def test_gaps_and_lines(tmp_path):
    table = columns(tmp_path, "# a\nt,node,y0\n1,0,\n\n2,0,nan\n3,0,4\n", gaps=("y0",))
    assert np.isnan(table["y0"]).tolist() == [True, True, False]
    assert table.lines.tolist() == [3, 5, 6]
    assert table.where(2, 0) == "table.csv lines 3 and 6"


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_stamps_since_1970_keep_all_digits(tmp_path, unit):
    rng = np.random.default_rng(3)
    scale = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    origin = Decimal("1693918993.961234567")
    stamps = [1693918993961234567 + int(k) for k in np.sort(rng.integers(0, 10**11, 50))]
    texts = [str(Decimal(k) / 10**9 * scale) for k in stamps]
    table = columns(
        tmp_path, "t,node,y0\n" + "".join(f"{t},0,1\n" for t in texts), TimeBase(unit, origin)
    )
    expected = [float(Fraction(k - 1693918993961234567, 10**9)) for k in stamps]
    assert table["t"].tolist() == expected


@pytest.mark.parametrize(
    ("unit", "text", "expected"),
    [
        ("s", "3", 0.505),
        ("ms", "3", 0.001),
        ("ms", "3.25", 1e-5),
        ("s", "1970-01-01T00:00:03.5", 0.055),
    ],
)
def test_a_stamp_and_its_origin_are_each_off_by_half_of_a_digit(unit, text, expected):
    origin = TimeBase(unit, Decimal("1.25"))  # of hundredths, or of as many digits as the stamp
    assert origin.half_digit(text) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "2009-07-22T15:10:04.538Z",
        "2009-07-22 15:10:04.538",
        "2009-07-22T17:10:04,538+02:00",
        "20090722T151004.538Z",
        "2009-07-22T15:10:04.538123456Z",
        "1969-12-31T23:59:59.25Z",
        "2009-07-22",
    ],
)
def test_iso_times_are_those_of_pandas(tmp_path, text):
    stamp = pd.Timestamp(text.replace(",", "."))
    nanoseconds = (stamp if stamp.tz else stamp.tz_localize("UTC")).value
    separator = ";" if "," in text else ","
    table = columns(tmp_path, separator.join(("t", "node")) + f"\n{text}{separator}0\n",
                    TimeBase("ms", Decimal(1248275404)), ("t",))  # fmt: skip
    assert table["t"][0] == float(Fraction(nanoseconds, 10**9) - 1248275404)


READINGS = "t,node,y0\n1248275404.538,0,0.1246\n1248275404.773,1,0.5421\n1248275405.509,0,0.8492\n"


def scenario(folder, readings=READINGS, **keys):
    (folder / "readings.csv").write_text(readings)
    (folder / "scenario.toml").write_text(
        """
        format = 1
        name = "epoch"
        horizon = 10.0
        probe = 0.5
        [plant]
        kind = "unknown"
        A = [[0.0, 1.0], [0.0, 0.0]]
        B = [[0.0], [1.0]]
        cov = [[1.0, 0.0], [0.0, 1.0]]
        [[sensors]]
        kind = "recorded"
        path = "readings.csv"
        H = [[1.0, 0.0]]
        R = [[0.01]]
        [network]
        graph = { kind = "path", nodes = 2 }
        activation = { kind = "readings" }
        [filter]
        kind = "intermittent"
        """
    )
    return netkf.load(folder / "scenario.toml", keys)


def times(s):
    return s.sensors[0].record.rows(0).t.tolist()


def test_records_that_begin_long_after_0_are_noted(tmp_path):
    (note,) = scenario(tmp_path).notes[-1:]
    assert "the first at t = 1248275404.538" in note
    assert "origin = 1248275404," in note


@pytest.mark.parametrize(
    "origin", [1248275404, 1248275404.0, "1248275404.000", "2009-07-22T17:10:04+02:00"]
)
def test_an_origin_is_a_number_or_a_time(tmp_path, origin):
    s = scenario(tmp_path, **{"time.origin": origin})
    assert times(s) == [0.538, 1.509]
    assert not s.notes


def test_toml_times_files_of_their_own_and_python(tmp_path):
    s = scenario(tmp_path)
    text = (tmp_path / "scenario.toml").read_text()
    (tmp_path / "scenario.toml").write_text(text + "[time]\norigin = 2009-07-22T15:10:04Z\n")
    read = netkf.load(tmp_path / "scenario.toml")
    assert times(read) == [0.538, 1.509]
    netkf.save(netkf.simulate(read), read, tmp_path / "out")
    resolved = (tmp_path / "out" / "scenario.toml").read_text()
    assert 'origin = "2009-07-22T15:10:04+00:00"\nunit = "s"' in resolved
    (tmp_path / "again.toml").write_text(resolved)
    assert times(netkf.load(tmp_path / "again.toml")) == [0.538, 1.509]
    # Parts made without the scenario are read anew with its [time].
    made = netkf.Scenario(
        s.name, s.horizon, s.plant, s.sensors, s.network, s.filter, s.probe,
        time=netkf.Time(origin=1248275404),
    )  # fmt: skip
    assert times(made) == [0.538, 1.509]
    assert times(made.replace({"time.origin": 1248275403})) == [1.538, 2.509]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("origin", "yesterday"),
        ("origin", True),
        ("origin", float("nan")),
        ("origin", 1e30),
        ("origin", "1e99999"),
        ("origin", [1]),
        ("unit", "h"),
        ("zone", "CET"),
    ],
)
def test_wrong_keys_of_time(tmp_path, key, value):
    with pytest.raises(netkf.ScenarioError) as refused:
        scenario(tmp_path, **{f"time.{key}": value})
    assert f"time.{key}: " in str(refused.value)
