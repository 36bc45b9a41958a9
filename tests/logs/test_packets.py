"""Packet logs: what they say is in the tables, and nothing else; a run comes back to the bit."""

import gzip
import math
import os
from decimal import Decimal, localcontext

import networkx
import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.logs.packets import choose_origin, find_lead, spread_equal, unwrap
from netkf.scenario.reading import from_table
from netkf.scenario.writing import as_table, to_toml
from tests.conftest import SCENARIOS

MERCATOR = """\
timestamp,mac,frequency,length,rssi,crc,expected,srcmac,transctr,pkctr,txnumpk,txpower,txifdur,txlength,txfillbyte
2014-09-07_22.41.23,22-22,11,100,-75,1,1,11-11,1,1,3,0,100,100,0x0a
2014-09-07_22.41.23,33-33,11,100,-85,1,1,11-11,1,3,3,0,100,100,0x0a
2014-09-07_22.41.23,33-33,11,100,-85,1,1,11-11,1,3,3,0,100,100,0x0a
2014-09-07_22.41.23,33-33,11,100,-85,0,1,11-11,1,2,3,0,100,100,0x0a
2014-09-07_22.41.24,33-33,11,100,-85,1,0,99-99,7,9,3,0,100,100,0x0a
2014-09-07_22.41.29,22-22,12,100,-65,1,1,11-11,4,2,3,0,100,100,0x0a
"""


def table(folder, name):
    return pd.read_csv(folder / name)


def write(path, rows):
    path.write_text("\n".join(rows) + "\n")
    return path


def made(tmp_path, count=300, modulus=256, step=0.7):
    """Rows (stamp in whole seconds, sender, receiver, number) of three nodes that hear each other
    with probability 0.7, and the numbers of packets heard.
    """
    random = np.random.default_rng(3)
    heard = {(i, j): 0 for i in range(3) for j in range(3) if i != j}
    rows = ["timestamp;SRC_ID;dst;seqno;rssi;battery"]
    for k in range(count):
        for i in range(3):
            for j in range(3):
                if i != j and random.random() < 0.7:
                    heard[i, j] += 1
                    rows.append(f"{int(5000 + step * k)};{i};{j};{k % modulus};-70,5;3")
    return write(tmp_path / "packets.csv", rows), heard


def test_a_log_of_receptions_with_short_numbers_and_coarse_stamps_balances(tmp_path, capsys):
    log, heard = made(tmp_path, modulus=16)
    out = tmp_path / "out"
    assert main(["import", str(log), "--kind", "csv", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    accounts = table(out, "accounts.csv")
    assert (accounts["sent"] == accounts[["heard", "lost", "unknown"]].sum(axis=1)).all()
    pairs = zip(accounts["sender"], accounts["receiver"], strict=True)
    assert dict(zip(pairs, accounts["heard"], strict=True)) == heard
    assert "numbers wrap after 16: 54 times" in printed
    assert "resolution: stamps are multiples of 1 s" in printed
    assert "not used: battery" in printed
    sent = table(out, "transmissions.csv")
    assert not sent.duplicated().any()  # none is merged
    assert set(sent.groupby("node").size()) <= {299, 300}  # the last may be heard by nobody
    run = netkf.simulate(netkf.load(out / "scenario.toml"), engine="simpy")
    kinds = run.events["kind"].value_counts()
    assert kinds["send"] == accounts["sent"].sum()
    assert kinds["deliver"] == sum(heard.values())
    assert kinds["lost"] == accounts[["lost", "unknown"]].to_numpy().sum()


def test_what_the_sender_logs_is_lost_and_what_only_numbers_tell_is_not_known(tmp_path):
    rx = ["t,src,dst,seq", "1,a,b,0", "2,a,b,1", "2,a,c,1", "5,a,b,4", "5,a,c,4"]
    for name, rows, expected in (
        ("rx", rx, [2, 2, 0, 1, 2]),
        ("tx", [*rx, "3,a,,2", "4,a,,3"], [3, 2, 0, 3, 0]),
    ):
        log = write(tmp_path / f"{name}.csv", rows)
        netkf.import_log(log, "csv", tmp_path / name)
        accounts = table(tmp_path / name, "accounts.csv").set_index("receiver")
        assert accounts.loc["b", ["sent", "heard", "lost", "unknown"]].tolist() == (
            [5, 3, 0, 2] if name == "rx" else [5, 3, 2, 0]
        )
        assert accounts.loc["c", ["heard", "lost", "unknown"]].tolist() == (
            expected[1:2] + ([1, 2] if name == "rx" else [3, 0])
        )
    netkf.import_log(tmp_path / "rx.csv", "csv", tmp_path / "lost", unreported="lost")
    assert table(tmp_path / "lost", "accounts.csv")["unknown"].sum() == 0


def test_a_sender_that_logs_what_it_sends_hardly_sent_what_its_log_does_not_have(tmp_path):
    heard = ["2,a,b,1", "2,a,c,1", "5,a,b,4"]
    own = ["t,src,dst,seq", "1,a,,0", "2,a,,1", "5,a,,4", *heard]
    for name, rows, why in (
        ("off", own, "its sender logs what it sends, and not this"),
        ("holes", [*own, "6,a,b,5"], "nobody reported it"),
    ):
        netkf.import_log(write(tmp_path / f"{name}.csv", rows), "csv", tmp_path / name)
        unknown = table(tmp_path / name, "unknown.csv")
        assert unknown["message"].tolist() == [2, 2, 3, 3]
        assert set(unknown["why"]) == {why}


def test_columns_of_any_name(tmp_path, capsys):
    rows = ["stamp;who;from whom;k;t;crc", "1000;2;3;0;x;yes", "2500;2;3;1;x;no"]
    log, out = write(tmp_path / "log.csv", rows), tmp_path / "out"
    columns = "t_ms=Stamp,sender=from whom,receiver=who,number=k"
    words = ["import", str(log), "--kind", "csv", "--out", str(out), "--columns"]
    assert main([*words, columns + ",heard=crc"]) == 0
    printed = capsys.readouterr().out
    assert "columns t from t_ms, sender, receiver, number" in printed
    assert "not used: t (of the log)" in printed
    sent = table(out, "transmissions.csv")
    assert np.diff(sent["t"]).tolist() == [1.5]
    assert table(out, "outcomes.csv")["delivered"].tolist() == [1, 0]
    given = dict(column.split("=") for column in columns.split(","))
    with localcontext(prec=1):  # of the caller
        netkf.import_log(log, "csv", tmp_path / "again", columns=given)
    assert np.diff(table(tmp_path / "again", "transmissions.csv")["t"]).tolist() == [1.5]
    assert main([*words[:2], "--kind", "csv", "--out", str(tmp_path / "no")]) == 2
    assert "name them: --columns t=COLUMN,..." in capsys.readouterr().err
    for wrong, said in (
        ("t=when", "must be columns of the log"),
        ("time=stamp", "must name one of t, sender"),
    ):
        assert main([*words[:-2], str(tmp_path / "no"), "--columns", wrong]) == 2
        assert said in capsys.readouterr().err
    assert main([*words[:-4], "ulb", *words[-3:], "t=stamp"]) == 2
    assert "are those of kind csv" in capsys.readouterr().err


def test_outcomes_events_and_repeated_rows(tmp_path, capsys):
    told = ["t_ms,src,dst,seq,ok", "1000,1,2,0,yes", "1000,1,3,0,no", "2000,1,2,1,", "2000,1,3,1,1"]
    log = write(tmp_path / "told.csv", [*told, "2000,1,3,1,1"])
    netkf.import_log(log, "csv", tmp_path / "told")
    outcomes = table(tmp_path / "told", "outcomes.csv")
    columns = ["receiver", "message", "delivered"]
    assert sorted(outcomes[columns].to_numpy().tolist()) == [[2, 0, 1], [3, 0, 0], [3, 1, 1]]
    assert table(tmp_path / "told", "accounts.csv")["unknown"].tolist() == [1, 0]
    assert "merged: 1 row of an outcome" in (tmp_path / "told" / "report.txt").read_text()
    events = ["t,node,event,peer,seq", "1,1,tx,,0", "1.5,2,rx,1,0", "2,1,tx,,1", "2.5,3,rx,1,1"]
    netkf.import_log(write(tmp_path / "e.csv", events), "csv", tmp_path / "events")
    accounts = table(tmp_path / "events", "accounts.csv")
    assert accounts[["sent", "heard", "lost"]].to_numpy().tolist() == [[2, 1, 1], [2, 1, 1]]
    assert table(tmp_path / "events", "transmissions.csv")["t"].tolist() == [1.0, 2.0]
    (tmp_path / "tables").mkdir()
    write(tmp_path / "tables" / "sent.csv", ["t,node,seq", "1,a,0", "2,a,1", "3,a,2"])
    write(tmp_path / "tables" / "heard.csv", ["t,node,src,seq", "1.1,b,a,0", "3.2,b,a,2"])
    netkf.import_log(tmp_path / "tables", "csv", tmp_path / "joined")
    assert table(tmp_path / "joined", "accounts.csv").to_numpy().tolist() == [
        ["a", "b", 3, 2, 1, 0]
    ]
    two = write(tmp_path / "two.csv", [*told, "1000,1,2,0,0"])
    assert main(["import", str(two), "--kind", "csv", "--out", str(tmp_path / "no")]) == 2
    error = capsys.readouterr().err
    assert "two.csv line 2 and two.csv line 6: one says heard and one says lost" in error
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["t,src,dst", "1,1,2", "1,2"], r"line 3 must have 3 entries"),
        (["t,src,dst", "1,1,2", "x,1,2"], r"line 3: t must be a number or an ISO 8601 time"),
        (["t,src,dst,seq", "1,1,2,1.5"], r"line 2: number must be an integer"),
        (["t,src,dst,seq", "1,1,2,x"], r"line 2: seq must be a number"),
        (["t,src,dst,seq", f"1,1,2,{2**60}"], r"line 2: number must be an integer from 0 to 2\^53"),
        (["t,src,1,2", "1,1,1,0"], r"must have packets that somebody heard"),
        (["t,src,seq,ok", "1,1,0,1"], r"must have packets that somebody heard"),
        (["t,src,dst", "1,1,2", "1e300,1,2"], r"line 3: t must be at most 1e\+30 s in size"),
        (["t,src,dst,ok", "1,1,2,maybe"], r"line 2: ok must say 1 or 0"),
        (["t,dst", "1,2"], r"must have a column sender"),
        (["t,src,dst", "1,2,2"], r"line 2: sender and receiver must differ"),
        (["t,src,dst", "1,,2"], r"line 2: must name a sender"),
        (["t,src,dst"], r"has no rows"),
        (["t src dst", "1 1 2"], r"must have several columns.*separate them by comma"),
        (["1,1,2", "2,2,1"], r"must name its columns"),
        (["t,src,dst,t_rx", "2,1,2,1"], r"line 2: is heard before it is sent"),
    ],
)
def test_a_bad_log_is_refused_with_its_line(tmp_path, rows, message):
    log = write(tmp_path / "log.csv", rows)
    with pytest.raises(ScenarioError, match=message):
        netkf.import_log(log, "csv", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("hole", [math.nan, -1.0, 0.0])
def test_a_hole_is_a_number_of_packets(tmp_path, hole):
    log = write(tmp_path / "log.csv", ["t,src,dst", "1,a,b"])
    with pytest.raises(ScenarioError, match="hole: must be a finite number above 0"):
        netkf.import_log(log, "csv", tmp_path / "out", hole=hole)


def test_names_that_tables_cannot_hold_are_others(tmp_path):
    log = write(tmp_path / "log.csv", ["t,src,dst", f"1,{'a' * 300},b"])
    (scenario, *_), _ = netkf.import_log(log, "csv", tmp_path / "out")
    assert set(netkf.load(scenario).topology.names) == {"n0", "n1"}


def test_every_node_with_another_name_is_listed(tmp_path):
    rows = ["t,src,dst,seq", *(f"{k},hut {k},hut_{k},0" for k in range(1, 9))]
    _, notes = netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    (listed,) = (n.partition("here: ")[2] for n in notes if "other names" in n)
    names = dict(pair.split(" is ") for pair in listed.split(", "))
    assert set(names) == {f"hut{mark}{k}" for mark in " _" for k in range(1, 9)}
    assert set(names.values()) == set(netkf.load(tmp_path / "out" / "scenario.toml").topology.names)


def test_a_silent_receiver_has_a_hole_if_others_hear(tmp_path):
    """Nodes 0, 1, 2 hear all of 400 packets of 3 and 4, but for a stretch of node 2, of all, and of
    one sender at node 1.
    """
    rows = ["t,src,dst,seq"]
    for k in range(200):
        for sender in (3, 4):
            rows += [f"{k},{sender},,{k}"]
            for receiver in range(3):
                silent = receiver == 2 and 50 <= k < 80
                silent |= 100 <= k < 130 or (receiver == 1 and sender == 3 and 150 <= k < 190)
                if not silent:
                    rows.append(f"{k}.5,{sender},{receiver},{k}")
    netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    accounts = table(tmp_path / "out", "accounts.csv").set_index(["sender", "receiver"])
    assert accounts.loc[(3, 2)].tolist() == [200, 140, 30, 30]
    assert accounts.loc[(3, 1)].tolist() == [200, 130, 70, 0]
    assert "2 reports nothing from 51 to 80 s" in (tmp_path / "out" / "report.txt").read_text()


@pytest.mark.parametrize("why", ["it logs what it sends", "one sender", "hardly heard"])
def test_losses_in_a_row_are_no_hole_in_the_log_of_their_receiver(tmp_path, why):
    """Node 1 misses 400 packets in a row that nodes 0 and 2 hear."""
    rows = ["t,src,dst,seq"]
    for k in range(800):
        senders = (3,) if why == "one sender" and k >= 400 else (3, 4)
        rows += [f"{k},{sender},,{k}" for sender in (*senders, *(1,) * (why[:7] == "it logs"))]
        for sender in senders:
            hears = k < 400 and (why != "hardly heard" or k % 10 == 0)
            rows += [f"{k}.5,{sender},{receiver},{k}" for receiver in (0, 2, *(1,) * hears)]
    netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    accounts = table(tmp_path / "out", "accounts.csv").set_index(["sender", "receiver"])
    heard = 40 if why == "hardly heard" else 400
    assert accounts.loc[(3, 1)].tolist() == [800, heard, 800 - heard, 0]


def test_nothing_is_sent_at_the_origin_of_a_log():
    stamps = [[0, 5], [3, 50], [3, 20], [1000, 1001], [1000.5, 1001]]
    origins = [choose_origin([Decimal(t) for t in pair], 0.001) for pair in stamps]
    assert origins == [-1, 0, 2, 999, 1000]


@pytest.mark.parametrize("modulus", [16, 256, 65536])
@pytest.mark.parametrize("delivery", [1.0, 0.5])
def test_counters_grow_on_through_wraps_holes_and_late_rows(modulus, delivery):
    random = np.random.default_rng(modulus)
    true = 65_000 + np.flatnonzero(random.random(3000) < delivery)
    true = true[(true < 65_900) | (true > 65_960)]
    times = true + random.uniform(0.0, 0.4, len(true))
    times[5], times[6] = times[6], times[5]
    order = np.argsort(times)
    counters, wraps, found, restarts = unwrap((true % modulus)[order], times[order])
    assert (found, restarts) == (modulus, 0)
    if modulus > 16 * 4:  # a hole of sixty hides whole turns of 16
        assert (np.diff(counters) == np.diff(true[order])).all()
        assert wraps == true[-1] // modulus - true[0] // modulus


@pytest.mark.parametrize("modulus", [16, 100, 256, 65536])
@pytest.mark.parametrize("share", [0.55, 0.7, 0.9])
def test_after_a_hole_of_half_a_cycle_packets_are_not_late_ones_of_before(modulus, share):
    true = np.arange(4 * modulus)[:: max(1, modulus // 1000)]
    begin = 2.05 * modulus
    true = true[(true < begin) | (true > begin + share * modulus)]
    times = true + np.random.default_rng(modulus).uniform(0.0, 0.4, len(true))
    counters, _, _, restarts = unwrap(true % modulus, times)
    assert restarts == 0
    assert (np.diff(counters) == np.diff(true)).all()


@pytest.mark.parametrize("modulus", [16, 256])
@pytest.mark.parametrize("share", [1.3, 1.6, 2.2, 3.9])
@pytest.mark.parametrize("begin", [0.3, 2.05])
def test_whole_cycles_that_nobody_heard_are_counted_by_time(modulus, share, begin):
    true = np.arange(8 * modulus)
    true = true[(true < begin * modulus) | (true > (begin + share) * modulus)]
    times = true + np.random.default_rng(modulus).uniform(0.0, 0.4, len(true))
    counters, _, _, restarts = unwrap(true % modulus, times)
    assert restarts == 0
    assert (np.diff(counters) == np.diff(true)).all()
    # A sender that pauses goes on with the very next number, however long it was silent.
    paused = np.arange(8 * modulus)
    times = paused + np.where(paused >= begin * modulus, share * modulus, 0.0)
    assert (np.diff(unwrap(paused % modulus, times)[0]) == 1).all()


@pytest.mark.parametrize("logged", [True, False])
@pytest.mark.parametrize(
    ("modulus", "interval", "stamp", "lead"),
    [(256, 0.1, 1.0, 0.0), (16, 0.1, 1.0, 0.0), (16, 10.0, 0.001, 5.0), (256, 10.0, 0.001, 48.0)],
)
def test_stamps_may_be_coarse_and_clocks_apart(tmp_path, modulus, interval, stamp, lead, logged):
    """Stamps of many packets, and of clocks that are several packets apart, hide no wrap and invent
    none; packets that nobody heard are counted, and stay in order.
    """
    random, ahead = (
        np.random.default_rng(modulus),
        {"a": 0.0, "b": -lead, "c": 0.5 * lead, "d": lead},
    )
    rows, true = [], {}
    for k in range(600):
        for place, i in enumerate(ahead):
            t = 1000.0 + interval * (k + 0.2 * place)
            what = [("tx", i, "")] if logged else []
            for j in ahead:
                if j != i:
                    # Receivers' logs begin and end with what everybody heard.
                    true.setdefault((i, j), []).append(k in (0, 599) or random.random() < 0.7)
                    what += [("rx", j, j)] if true[i, j][-1] else []
            for event, node, j in what:
                shown = np.floor((t + ahead[node]) / stamp + 1e-6) * stamp
                rows.append(f"{shown:.3f},{event},{i},{j},{k % modulus}")
    random.shuffle(rows)
    log = write(tmp_path / "log.csv", ["t,event,src,dst,seq", *rows])
    netkf.import_log(log, "csv", tmp_path / "out", unreported="lost", hole=1e9)
    outcomes = table(tmp_path / "out", "outcomes.csv").groupby(["sender", "receiver"])["delivered"]
    assert {link: own.tolist() for link, own in outcomes} == true
    sent = table(tmp_path / "out", "transmissions.csv").groupby("node")["t"]
    assert all(own.is_unique for _, own in sent)


@pytest.mark.parametrize("modulus", [256, 65536])
@pytest.mark.parametrize("lead", [0.3, 1.5])
def test_coarse_stamps_of_clocks_that_are_apart_are_one_count(tmp_path, modulus, lead):
    """Ten packets have one stamp, which two receivers give to other tens."""
    random, ahead = np.random.default_rng(2), np.array([0.0, 1.0, -1.0]) * lead
    rows, first = ["t,src,dst,seq"], modulus - 40 * (modulus == 256)
    heard = random.random((300, 3)) < 0.7
    heard[[0, -1]] = True
    for k, j in zip(*np.nonzero(heard), strict=True):
        rows.append(f"{int(1000 + 0.1 * k + ahead[j])},s,{j},{(first + k) % modulus}")
    netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out", hole=1e9)
    accounts = table(tmp_path / "out", "accounts.csv").set_index("receiver")
    assert accounts["sent"].tolist() == [300] * 3
    outcomes = table(tmp_path / "out", "outcomes.csv")
    for j, own in outcomes[outcomes["delivered"] == 1].groupby("receiver"):
        assert own["message"].tolist() == np.flatnonzero(heard[:, int(str(j)[-1])]).tolist()


def test_transmissions_of_one_stamp_stay_before_the_next_where_clocks_were_aligned():
    sends = pd.DataFrame({"sender": "a", "to": "", "t": [1.2, 1.2, 1.2, 1.5, 1.5, 4.0]})
    spread_equal(sends, 1.0, [])
    assert sends["t"].is_monotonic_increasing
    np.testing.assert_allclose(sends["t"], [1.2, 1.3, 1.4, 1.5, 2.0, 4.0])


def test_the_interval_is_finer_than_the_stamps():
    """A packet each 2.5 s with stamps of whole seconds by two clocks, and 400 that nobody heard."""
    true = np.repeat([*range(1000), *range(1400, 2000)], 2)
    counters, *_ = unwrap(true % 256, np.floor(2.5 * true + np.tile([0.0, 0.4], len(true) // 2)))
    assert (np.diff(counters) == np.diff(true)).all()


def test_after_a_whole_cycle_nothing_is_late():
    true = np.array([*range(40), *range(101, 140)])  # 37 follows 39, 62 packets later
    counters, _, _, restarts = unwrap(true % 16, true + 5.0 * (true > 100))
    assert (np.diff(counters).min(), restarts) == (1, 0)


def test_clocks_that_are_near_each_other_in_two_parties_are_told_apart():
    """Of each number two stamps are near each other on both sides of a wide gap."""
    ahead = np.array([0.0, 0.5, 30.0, 30.5])
    times, numbers = (10.0 * np.arange(50)[:, None] + ahead).ravel(), np.repeat(np.arange(50), 4)
    order, who = np.argsort(times), np.tile(np.arange(4), 50)
    found = find_lead(numbers[order], times[order], who[order])
    np.testing.assert_allclose(found, ahead[who[order]], atol=1e-9)


def test_what_a_receiver_was_off_for_is_no_silence(tmp_path):
    rows = ["t,src,dst,seq", *(f"{k},1,2,{k}" for k in range(3000) if not 500 < k < 2500)]
    _, notes = netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    assert any("1,999 transmissions between numbers more than 1,000 apart" in n for n in notes)


def test_a_node_that_logs_what_was_sent_to_an_address_heard_it(tmp_path):
    rows = ["t,node,src,dst,seq,id"]
    for k in range(40):
        rows += [f"{k},1,1,255,{k},{3 * k}", f"{k},02,1,255,{k},{3 * k + 1}"]
        rows += [f"{k},2,1,255,{k},{3 * k + 2}"] * (k % 2)
    netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    accounts = table(tmp_path / "out", "accounts.csv")
    assert accounts.to_numpy()[:, 2:].tolist() == [[40, 40, 0, 0], [40, 20, 20, 0]]
    # 02 and 2 are two nodes here, and would be one in a table.
    run = netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml"))
    assert (len(run.nodes), run.count("deliver"), run.count("lost")) == (3, 60, 20)


def test_a_node_that_logs_its_own_packet_sent_it(tmp_path):
    rows = ["t,node,event,src,seq"]
    for k in range(1, 9):
        rows += [f"{k},a,SEND,a,{k}"] + [f"{k + 0.01},b,RECV,a,{k}"] * (k % 2)
    log = write(tmp_path / "log.csv", [*rows, "9,b,SEND,b,1", "9.01,a,RECV,b,1"])
    netkf.import_log(log, "csv", tmp_path / "out")
    accounts = table(tmp_path / "out", "accounts.csv").set_index(["sender", "receiver"])
    assert accounts.loc[("a", "b")].tolist() == [8, 4, 4, 0]
    with pytest.raises(ScenarioError, match="line 2: must name a receiver"):
        netkf.import_log(write(log, [rows[0], "1,a,RECV,a,1"]), "csv", tmp_path / "no")


def test_a_clock_that_begins_again_is_told(tmp_path):
    """Node 2 boots at packet 100 and counts its seconds from 0 on, its numbers too in one log."""
    for name, first in (("numbers", 100), ("clock", 0)):
        rows = ["t,node,src,dst,seq"]
        for k in range(200):
            late, number = 100.0 * (k >= 100), k - first * (k >= 100)
            rows += [f"{k},1,1,,{k}", f"{k - late},2,1,,{k}"]
            rows += [f"{k + 0.5 - late},2,2,,{number}", f"{k + 0.5},1,2,,{number}"]
        log = write(tmp_path / f"{name}.csv", rows)
        with pytest.raises(
            ScenarioError, match=r"numbers of 1 begin again \d+ times: stamps do not"
        ):
            netkf.import_log(log, "csv", tmp_path / "out")
    rows = ["t,src,dst,seq", "5,1,2,0", "6,1,2,1", "4.9,1,2,0"]
    _, notes = netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    assert "sorted: stamps fall from row to row 1 time, by up to 1.1 s" in notes
    assert "merged: 1 row of an outcome told before, up to 0.1 s apart" in notes


def test_one_of_before_the_wrap_may_come_late():
    counters, wraps, *_ = unwrap(np.array([253, 255, 0, 254, 1, 2]), np.arange(6.0))
    assert (counters.tolist(), wraps) == ([253, 255, 256, 254, 257, 258], 1)


def test_the_stamp_of_the_sender_counts(tmp_path):
    rows = ["t,sender,receiver,number,event"]
    rows += [f"{k + 0.05 * (-1) ** k:.2f},0,1,{k},rx" for k in range(1, 20)]
    rows += [f"{k},0,,{k},tx" for k in range(1, 20)]
    netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    assert table(tmp_path / "out", "outcomes.csv")["t"].tolist() == list(range(1, 20))


def test_counters_begin_again():
    numbers = np.array([*range(40, 70), *range(30), *range(5)])
    counters, wraps, _, restarts = unwrap(numbers, np.arange(len(numbers), dtype=float))
    assert (wraps, restarts) == (0, 2)
    assert (np.diff(counters) == 1).all()


@pytest.mark.parametrize(("yes", "no"), [("1", "0"), ("True", "False"), ("1.0", "0.0")])
def test_mercator(tmp_path, yes, no):
    lines = [line.split(",") for line in MERCATOR.splitlines()]
    for line in lines[1:]:
        line[5:7] = (yes if flag == "1" else no for flag in line[5:7])
    log = write(tmp_path / "raw.csv", [",".join(line) for line in lines])
    _, notes = netkf.import_log(log, "mercator", tmp_path / "out")
    text = "\n".join(notes)
    for note in (
        "dropped: 1 row of no packet of the experiment",
        "dropped: 1 row with a wrong crc",
        "merged: 1 row that repeat a packet",
        "not known: 2 bursts that numbers tell of",
        "outcomes: 12 = 3 heard + 9 lost + 0 unknown",
    ):
        assert note in text
    outcomes = table(tmp_path / "out", "outcomes.csv")
    heard = outcomes[outcomes["delivered"] == 1]
    columns = ["receiver", "message", "channel", "rssi"]
    assert heard[columns].to_numpy().tolist() == [
        *(["22-22", 0, 11, -75.0], ["33-33", 2, 11, -85.0], ["22-22", 4, 12, -65.0]),
    ]
    times = table(tmp_path / "out", "transmissions.csv")["t"].to_numpy()
    np.testing.assert_allclose(np.diff(times), [0.1, 0.1, times[3] - times[2], 0.1, 0.1])
    stamps = np.array([1, 1, 7]) - 0.0  # the log begins a second after the origin
    received = times[[0, 2, 4]]
    assert ((stamps <= received) & (received < stamps + 1)).all()


def test_bursts_of_mercator_within_one_second_stay_apart(tmp_path):
    """Three bursts of 0.21 s in each second: packet k of burst b is heard where k + b is even."""
    rows = [MERCATOR.splitlines()[0]]
    for burst in range(12):
        for k in range(burst % 2, 3, 2):
            stamp = f"2014-09-07_22.41.{23 + burst // 3}"
            rows.append(f"{stamp},22-22,11,100,-75,1,1,11-11,{burst},{k},3,0,70,100,0x0a")
        rows.append(f"{stamp},33-33,11,100,-75,1,1,11-11,{burst},0,3,0,70,100,0x0a")
    _, notes = netkf.import_log(write(tmp_path / "raw.csv", rows), "mercator", tmp_path / "out")
    outcomes = table(tmp_path / "out", "outcomes.csv").groupby("receiver")["delivered"]
    assert outcomes.get_group("22-22").tolist() == [1, 0, 1, 0, 1, 0] * 6
    assert outcomes.get_group("33-33").tolist() == [1, 0, 0] * 12
    assert not any(note.startswith("moved") for note in notes)
    times = table(tmp_path / "out", "transmissions.csv")["t"]
    assert (times // 1.0).tolist() == [1.0 + burst // 3 for burst in range(12) for _ in range(3)]


@pytest.mark.parametrize("column", ["mac", "srcmac", "txnumpk"])
def test_rows_of_mercator_that_make_no_sense_are_dropped(tmp_path, column):
    """Motes without a name, and a burst of more packets than fit in memory."""
    head, *rows = [line.split(",") for line in MERCATOR.splitlines()]
    wrong = {"txnumpk": "1e12"}.get(column, "")
    changed = [
        [wrong if name == column else x for name, x in zip(head, row, strict=True)] for row in rows
    ]
    log = write(tmp_path / "raw.csv", [",".join(row) for row in (head, *rows, *changed)])
    _, notes = netkf.import_log(log, "mercator", tmp_path / "out")
    assert any("whose entries make no sense" in note for note in notes)
    assert any("outcomes: 12 = 3 heard + 9 lost + 0 unknown" in note for note in notes)
    log = write(tmp_path / "wrong.csv", [",".join(row) for row in (head, *changed)])
    with pytest.raises(ScenarioError, match="has no packet of the experiment"):
        netkf.import_log(log, "mercator", tmp_path / "none")


@pytest.mark.parametrize(
    ("readings", "heard", "rule"),
    [
        (["node,y", "1,2"], ["t,receiver,sender", "1,2,1"], "must have a column t"),
        (["t,node,y", "1,,2"], ["t,receiver,sender", "1,2,1"], "line 2: must name a node"),
        (["t,node,y", "1,1,2"], ["t,receiver,sender", "1,2,1", "1,,1"], "line 3: must name a rec"),
    ],
)
def test_tables_of_ulb_name_motes_and_times(tmp_path, readings, heard, rule):
    write(tmp_path / "readings.csv", readings)
    write(tmp_path / "heard.csv", heard)
    with pytest.raises(ScenarioError, match=rule):
        netkf.import_log(tmp_path, "ulb", tmp_path / "out")


def test_ulb_counts_missing_reports_as_unknown(tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    rows = [f"{60 * m + 10 + i}.25,{i},20.5,50" for m in range(3) for i in (1, 2, 3)]
    write(log / "readings.csv", ["t_s,node,temperature_c,humidity_pct", *rows])
    # Reports of minutes 0, 1, 2 by 2; of 0 and 2 by 3, which hears 1 in minute 0 only.
    reports = [*("60.5,2,1,99", "120.5,2,1,99", "180.5,2,1,90", "60.7,3,1,80"), "180.7,3,2,70"]
    write(log / "heard.csv", ["t_s,receiver,sender,lqi", *reports, "180.9,3,2,70"])
    netkf.import_log(log, "ulb", tmp_path / "out")
    accounts = table(tmp_path / "out", "accounts.csv").set_index(["sender", "receiver"])
    report = (tmp_path / "out" / "report.txt").read_text()
    assert "resolution: stamps are multiples of 0.01 s" in report  # those of readings too
    assert accounts.loc[(1, 2)].tolist() == [3, 3, 0, 0]
    assert accounts.loc[(1, 3)].tolist() == [3, 1, 1, 1]
    assert accounts.loc[(2, 3)].tolist() == [3, 1, 1, 1]
    run = netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml"), engine="simpy")
    assert not run.truth_known


PROBES = 5  # samples of a run
RUNS = {
    "poisson_ring": {"horizon": 2.0},
    "delayed_links": {"horizon": 4.0},
    "gossip_ring": {"horizon": 20.0},
    "diffusion_regression": {"horizon": 10.0},
    "intermittent_random10": {"horizon": 10.0},
    "push_sum_planar": {"horizon": 2.5},
}
COMPILED = ["poisson_ring", "push_sum_planar"]


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        *(pytest.param(name, "simpy", marks=pytest.mark.one_in(6)) for name in RUNS),
        *((name, "compiled") for name in COMPILED),
    ],
)
def test_a_run_written_as_a_log_comes_back_to_the_bit(name, engine, tmp_path):
    """Events and states, in slots and under clocks of links, nodes, directions and readings, with
    delays and messages under way at the end.
    """
    scenario = netkf.load(
        SCENARIOS / f"{name}.toml", {**RUNS[name], "probe": RUNS[name]["horizon"] / PROBES}
    )
    run = netkf.simulate(scenario, replica=2, engine=engine)
    netkf.export_log(run, tmp_path / "log")
    netkf.import_log(tmp_path / "log", "csv", tmp_path / "out")
    again = netkf.load(tmp_path / "out" / "scenario.toml")
    replay = netkf.simulate(again, replica=2, engine=engine)
    assert netkf.first_difference(run, replay) is None
    np.testing.assert_array_equal(run.xhat, replay.xhat)
    np.testing.assert_array_equal(run.P, replay.P)
    accounts = table(tmp_path / "out", "accounts.csv")
    assert (accounts["sent"] == accounts["heard"] + accounts["lost"]).all()
    # What happened, in place of its causes: the last sample in slots too.
    netkf.export_recorded(run, tmp_path / "twin")
    twin = netkf.load(tmp_path / "twin" / "scenario.toml")
    assert twin.network.channel.loss.path.name == "losses.csv"
    replay = netkf.simulate(twin, replica=2, engine=engine)
    assert netkf.first_difference(run, replay) is None
    np.testing.assert_array_equal(run.xhat, replay.xhat)
    np.testing.assert_array_equal(run.P, replay.P)


@pytest.mark.parametrize("case", ["lives", "clocks"])
def test_lives_of_link_ends_and_times_of_wrong_clocks_come_back_to_the_bit(case, tmp_path):
    """What an end that is down would have sent predicts nobody; messages under way at the end have
    no time that would refine the grid of a drifting clock.
    """
    given = {
        "lives": {"lives": [{"kind": "duty", "nodes": [2], "period": 2.0, "up": 1.3}]},
        "clocks": {"clocks": [{"nodes": [1], "offset": -0.2, "drift": 0.01}]},
    }
    on_readings = {"kind": "readings"}
    network = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "poisson", "rate": 2.0} if case == "lives" else on_readings,
        "channel": {
            "loss": {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 3.0},
            "delay": {"kind": "exponential", "mean": 0.2},
            "symmetric": False,
        },
    }
    sampling = {"kind": "periodic", "period": 0.5}
    table = {
        **{"format": 1, "name": "back", "horizon": 6.0, "probe": 0.5},
        "plant": {"kind": "diffusion", "A": [[-0.2]], "B": [[1.0]], "cov": [[2.0]]},
        "sensors": [{"nodes": [0, 1, 2], "H": [[1.0]], "R": [[0.3]], "sampling": sampling}],
        "network": network | given[case],
        "filter": {"kind": "diffusion" if case == "clocks" else "gossip"},
    }
    for seed in range(8):
        run = netkf.simulate(from_table(table, tmp_path), seed=seed)
        netkf.export_log(run, tmp_path / f"log{seed}")
        netkf.import_log(tmp_path / f"log{seed}", "csv", tmp_path / f"out{seed}")
        netkf.export_recorded(run, tmp_path / f"twin{seed}")
        for folder in ("out", "twin"):
            replay = netkf.simulate(netkf.load(tmp_path / f"{folder}{seed}" / "scenario.toml"))
            assert netkf.first_difference(run, replay) is None
            np.testing.assert_array_equal(run.xhat, replay.xhat)
            np.testing.assert_array_equal(run.P, replay.P)


CAUSES = {
    "lives": {"lives": [{"kind": "crashes", "nodes": [1], "mean_up": 2.0, "mean_down": 1.0}]},
    "radio": {"radio": {"bits_per_second": 2000.0, "frame_bytes": 20}},
    "radio alone": {
        "radio": {"bits_per_second": 2000.0, "frame_bytes": 20},
        "channel": {"symmetric": False},
    },
    "clocks": {"clocks": [{"nodes": [0], "offset": 0.05, "drift": -1e-3}]},
}


def test_names_with_commas_and_quotes_stand_in_the_tables_of_a_twin(tmp_path):
    names = ["a,b", "c\"d'e\\f"]
    life = {"kind": "crashes", "nodes": names, "mean_up": 1.0, "mean_down": 0.5}
    network = {
        "graph": {"kind": "edges", "edges": [names]},
        "activation": {"kind": "periodic", "period": 0.5, "at": "nodes"},
        "channel": {"loss": {"kind": "distance", "delivery": [[0.0, 1.0], [9.0, 0.1]]}},
        "lives": [life],
    }
    pose = {"name": "pose", "nodes": names, "position": [0], "cov": [[1.0]]}
    sampling = {"kind": "periodic", "period": 0.5}
    table = {
        **{"format": 1, "name": "names", "horizon": 4.0, "probe": 1.0, "network": network},
        "plants": [pose | {"A": [[-0.1]], "B": [[1.0]]}],
        "sensors": [{"nodes": names[:1], "H": [[1.0]], "R": [[0.1]], "sampling": sampling}],
        "filter": {"kind": "block-intersection", "estimates": "own"},
    }
    run = netkf.simulate(from_table(table, tmp_path))
    path = netkf.export_recorded(run, tmp_path / "twin")[-1]
    assert netkf.first_difference(run, netkf.simulate(netkf.load(path))) is None


@pytest.mark.parametrize("cause", CAUSES)
def test_a_log_counts_a_cause_once(cause, tmp_path):
    """Who is down, the time of a radio and wrong clocks are in the scenario and in the log."""
    sampled = {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.3]], "sampling": {"kind": "poisson"}}
    sampled["sampling"]["rate"] = 2.0
    network = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "poisson", "rate": 3.0, "at": "nodes"},
        "channel": {"delay": {"kind": "exponential", "mean": 0.2}, "symmetric": False},
    }
    changes = {"sensors": [sampled], "network": network | CAUSES[cause], "horizon": 8.0}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    run = netkf.simulate(scenario, engine="simpy")
    netkf.export_log(run, tmp_path / "log")
    _, notes = netkf.import_log(tmp_path / "log", "csv", tmp_path / "out")
    assert any("the rate of network.radio" in note for note in notes) == ("radio" in cause)
    netkf.export_recorded(run, tmp_path / "twin")
    for folder in ("out", "twin"):
        replay = netkf.simulate(netkf.load(tmp_path / folder / "scenario.toml"), engine="simpy")
        assert netkf.first_difference(run, replay) is None
        np.testing.assert_array_equal(run.xhat, replay.xhat)


SOME_LINKS = {
    "contacts": {"kind": "contacts", "path": "contacts.csv", "at": "links"},
    "links": {"kind": "periodic", "period": 0.5, "at": "links"},
    "nodes": {"kind": "periodic", "period": 0.5, "at": "nodes"},
    "readings": {"kind": "readings"},
    "slots": {"kind": "broadcast"},
}


@pytest.mark.parametrize("delivery", [0.6, 1.0])
@pytest.mark.parametrize("name", SOME_LINKS)
def test_of_a_run_nothing_is_taken_to_be_sent_over_a_link_that_is_down(name, delivery, tmp_path):
    """Nodes send at one instant, now to these and now to those: numbers of directions differ."""
    rows = ["from,until,node,peer", "0,3,0,1", "2,6,1,2", "5,9,0,2"]
    write(tmp_path / "contacts.csv", rows)
    rows = ["t,node,x,y", "0,0,0,0", "0,1,1,0", "0,2,2,0", "3,2,0.5,0", "5,1,5,5", "7,1,0.3,0"]
    write(tmp_path / "places.csv", rows)
    activation, in_slots = SOME_LINKS[name], name == "slots"
    if name == "contacts":
        activation = {**activation, "clock": {"kind": "periodic", "period": 0.5}}
        network = {"graph": {"kind": "complete", "nodes": 3}}
    else:
        graph = {"kind": "range", "nodes": 3, "radius": 1.6}
        network = {"graph": graph, "positions": "places.csv"}
    loss = {"kind": "bernoulli", "delivery": delivery}
    network |= {"activation": activation, "channel": {"loss": loss, "symmetric": False}}
    sensor = {"nodes": [0, 1, 2], "H": [[1.0]], "R": [[0.5]]}
    plant = {"kind": "linear", "F": [[0.9]], "Q": [[0.2]], "period": 1.0}
    if not in_slots:
        sensor["sampling"] = {"kind": "periodic", "period": 0.7}
        plant = {"kind": "diffusion", "A": [[-0.1]], "B": [[0.5]]}
    keys = {"format": 1, "name": name, "horizon": 10.0, "probe": 1.0, "network": network}
    keys |= {"plant": {**plant, "cov": [[1.0]]}, "sensors": [sensor]}
    weighted = {"kind": "covariance-intersection", "epsilon": 0.3}
    keys["filter"] = {"kind": "diffusion"} if in_slots else weighted
    (tmp_path / "run.toml").write_text(to_toml(keys))
    run = netkf.simulate(netkf.load(tmp_path / "run.toml"), engine="simpy")
    netkf.export_log(run, tmp_path / "log")
    netkf.import_log(tmp_path / "log", "csv", tmp_path / "out")
    replay = netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml"), engine="simpy")
    assert netkf.first_difference(run, replay) is None
    np.testing.assert_array_equal(run.xhat, replay.xhat)
    accounts = pd.read_csv(tmp_path / "out" / "accounts.csv")
    assert accounts["sent"].sum() == run.count("send")
    assert not accounts["unknown"].any()


PAIRS = """
format = 1
name = "pairs"
horizon = 10.0
probe = 1.0
plant = { kind = "linear", F = [[0.9]], Q = [[0.1]], period = 1.0, cov = [[1.0]] }
sensors = [{ nodes = [0], H = [[1.0]], R = [[0.5]] }]
[network]
graph = { kind = "complete", nodes = 3 }
activation = { kind = "matching", protocol = "one-edge" }
channel = { symmetric = false }
[filter]
kind = "gossip"
"""


@pytest.mark.parametrize("steps", [0, 2])
def test_rows_of_a_run_may_stand_in_any_order_and_repeat(steps, tmp_path):
    """Of several messages of a direction at one instant their numbers tell the order."""
    text = PAIRS.replace("symmetric", 'loss = { kind = "bernoulli", delivery = 0.5 }, symmetric')
    if steps:
        text = text.replace('matching", protocol = "one-edge"', 'broadcast"')
        text = text.replace('"gossip"', f'"hcmci"\nsteps = {steps}')
    (tmp_path / "run.toml").write_text(text)
    netkf.export_log(netkf.simulate(netkf.load(tmp_path / "run.toml")), tmp_path / "log")
    packets = tmp_path / "log" / "packets.csv"
    source, head, *rows = packets.read_text().splitlines()
    found = []
    for order in (rows, [*rows[::-1], rows[3]]):
        write(packets, [source, head, *order])
        netkf.import_log(tmp_path / "log", "csv", tmp_path / f"out{len(found)}")
        outcomes = table(tmp_path / f"out{len(found)}", "outcomes.csv")
        found.append(outcomes.drop(columns="transmission").sort_values([*outcomes][:3]))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize(
    ("rows", "sent", "told"),
    [
        (["1,0,1,0,1", "1,1,0,0,1", "2,0,1,1,0", "2,1,0,1,1"], 4, ""),
        (["1,0,1,0,1", "2,1,0,0,1"], 4, "sent beside the log: 2 messages the other way"),
        (["1,0,1,0,1", "1.5,0,1,1,1", "1,1,0,0,1"], 2, "merged: 1 message with another"),
    ],
)
def test_a_log_beneath_a_filter_that_exchanges_in_pairs(rows, sent, told, tmp_path):
    log = write(tmp_path / "log.csv", ["t,sender,receiver,number,heard", *rows])
    (tmp_path / "pairs.toml").write_text(PAIRS)
    _, notes = netkf.import_log(log, "csv", tmp_path / "out", like=tmp_path / "pairs.toml")
    assert told in str(notes)
    assert told or "beside" not in str(notes)
    assert netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml")).count("send") == sent
    both = ["1,0,1,0,1", "1,0,2,0,1", "2,1,2,0,1"]
    log = write(tmp_path / "log.csv", ["t,sender,receiver,number,heard", *both])
    with pytest.raises(ScenarioError, match="nodes send broadcasts, as in the log"):
        netkf.import_log(log, "csv", tmp_path / "no", like=tmp_path / "pairs.toml")


def test_pairs_of_a_log_exchange_in_the_slot_of_their_stamp(tmp_path):
    # In floats 0.3 is less than three times 0.1.
    rows = ["t,sender,receiver,number,heard", "0.3,0,1,0,1", "0.3,1,0,0,1", "0.65,0,1,1,0"]
    text = PAIRS.replace("period = 1.0", "period = 0.1").replace("probe = 1.0", "probe = 0.1")
    (tmp_path / "pairs.toml").write_text(text)
    log, like = write(tmp_path / "log.csv", rows), tmp_path / "pairs.toml"
    netkf.import_log(log, "csv", tmp_path / "out", like=like)
    assert table(tmp_path / "out", "transmissions.csv")["slot"].tolist() == [3, 6]


def test_what_nobody_in_the_scenario_sent_is_dropped_and_told(tmp_path):
    rows = ["t,sender,receiver,number,event"]
    rows += [f"{k},{i},,{k},tx" for k in range(1, 5) for i in (0, 1, 9)]
    rows += [f"{k},{k % 2},{1 - k % 2},{k},rx" for k in range(1, 5)]
    (tmp_path / "pairs.toml").write_text(PAIRS)
    log, out = write(tmp_path / "log.csv", rows), tmp_path / "out"
    _, notes = netkf.import_log(log, "csv", out, like=tmp_path / "pairs.toml")
    assert "dropped: 4 transmissions of nodes that the scenario has not: 9" in notes
    assert netkf.simulate(netkf.load(out / "scenario.toml")).count("deliver") == 4


def test_a_replay_lasts_until_the_last_packet_is_heard(tmp_path):
    rows = ["t,sender,receiver,t_heard", *(f"{k},0,{1 + k % 2},{k + 1.5}" for k in range(1, 6))]
    log, out = write(tmp_path / "log.csv", rows), tmp_path / "out"
    netkf.import_log(log, "csv", out)
    assert netkf.simulate(netkf.load(out / "scenario.toml")).count("deliver") == 5


SENSORS = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.25]]}]


def test_places_and_readings_beside_a_log_are_taken_whole_or_counted(tmp_path):
    rows = ["t,sender,receiver,number", *(f"{k},{k % 2},{1 - k % 2},{k}" for k in range(1, 9))]
    (tmp_path / "packets.csv").write_text("\n".join(rows))
    places = ["t_ms,id,x,y", "1000,0,0,0", "3000,1,5,5", "4000,0,1,0", "4000,0,1,0", "9,7,1,1"]
    (tmp_path / "positions.csv").write_text("\n".join(places))
    (tmp_path / "readings.csv").write_text("t,node,a,b\n-5,0,1,2\n2,0,,2\n3,1,4,5\n")
    paths, notes = netkf.import_log(tmp_path, "csv", tmp_path / "out")
    origin = float(notes[0].split()[4])
    table = pd.read_csv(tmp_path / "out" / "positions.csv").to_numpy().tolist()
    # The first place of node 1 holds from the beginning.
    first = max(1.0 - origin, 0.0) if origin >= 1.0 else 0.0
    assert table == [[first, 0, 0, 0], [0.0, 1, 5, 5], [4.0 - origin, 0, 1, 0]]
    assert netkf.load(paths[0]).positions.moving
    text = "\n".join(notes)
    assert "merged: 1 row of positions.csv" in text
    assert "dropped: 1 reading without a value" in text
    assert "dropped: 1 reading before time 0" in text
    assert "dropped: 1 position of nodes that are not in the network" in text
    assert "not used: readings.csv: columns b, but a as y0" in text
    (tmp_path / "positions.csv").write_text("\n".join([*places, "4000,0,2,0"]))
    with pytest.raises(ScenarioError, match="lines 4 and 7: a node must have one position at a t"):
        netkf.import_log(tmp_path, "csv", tmp_path / "two")


@pytest.mark.parametrize("names", ["abcd", "abdc"])
def test_the_model_of_readings_does_not_depend_on_names(names, tmp_path):
    rows = ["t,sender,receiver,number", *(f"{k},a,{'bcd'[k % 3]},{k}" for k in range(9))]
    (tmp_path / "packets.csv").write_text("\n".join(rows))
    values = zip(names, (1.827, 0.322, -0.278, 1.858), strict=True)
    rows = ["t,node,y0", *(f"1,{node},{y}" for node, y in values)]
    (tmp_path / "readings.csv").write_text("\n".join(rows))
    paths, _ = netkf.import_log(tmp_path, "csv", tmp_path / "out")
    assert netkf.load(paths[0]).plant.mean.tolist() == [0.9323]


def test_columns_of_decimal_commas_may_have_whole_numbers(tmp_path):
    write(tmp_path / "log.csv", ["t;src;dst;seq", "1;1;2;0", "2,5;1;2;1", "3;2;1;0"])
    write(tmp_path / "positions.csv", ["node;x;y", "1;0;3", "2;10,5;4"])
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    assert table(tmp_path / "out", "positions.csv")["x"].tolist() == [0.0, 10.5]
    assert table(tmp_path / "out", "transmissions.csv")["t"].tolist() == [1.0, 2.5, 3.0]


def test_a_log_may_take_the_plant_of_a_scenario(tmp_path):
    log, _ = made(tmp_path, 50)
    changes = {"network.graph": {"kind": "complete", "nodes": 3}, "sensors": SENSORS}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    run = netkf.simulate(scenario.replace({"horizon": 1.0}), engine="simpy")
    netkf.save(run, run.scenario, tmp_path / "run")
    like = tmp_path / "run" / "scenario.toml"
    out = tmp_path / "out"
    netkf.import_log(log, "csv", out, like=like)
    scenario = netkf.load(out / "scenario.toml")
    assert scenario.plant.n == 2
    assert scenario.network.activation.at == "nodes"
    # What nodes that are down do not send shifts what becomes of the rest.
    lives = {"network.lives": [{"kind": "duty", "nodes": [1], "period": 4.0, "up": 2.0}]}
    (tmp_path / "run" / "down.toml").write_text(to_toml(as_table(netkf.load(like, lives))))
    _, notes = netkf.import_log(log, "csv", tmp_path / "b", like=tmp_path / "run" / "down.toml")
    assert any("a node that is down does not send what it sent" in note for note in notes)


def test_nodes_of_any_name_return_from_a_log(tmp_path):
    """Their names are those of --like, which stand beside their log."""
    graph = networkx.relabel_nodes(networkx.path_graph(4), {0: "nœud 1", 1: "a,b;'c", 2: "7"})
    changes = {"network.graph": graph, "sensors.0.nodes": ["nœud 1", "7"], "horizon": 4.0}
    loss = {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes | {"network.channel": loss})
    run = netkf.simulate(scenario, engine="simpy")
    netkf.save(run, scenario, tmp_path / "run")
    netkf.export_log(run, tmp_path / "log")
    like = tmp_path / "run" / "scenario.toml"
    netkf.import_log(tmp_path / "log", "csv", tmp_path / "out", like=like)
    again = netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml"), engine="simpy")
    pd.testing.assert_frame_equal(run.states, again.states, check_exact=True)
    assert run.events.equals(again.events)


def test_the_origin_and_decimals_of_stamps_are_kept(tmp_path):
    rows = ["time,src,dst,seq", "2020-01-01T00:00:00.250Z,x y,b,0", "2020-01-01T00:00:01.5,x y,b,1"]
    _, notes = netkf.import_log(write(tmp_path / "a.csv", rows), "csv", tmp_path / "out")
    assert f"origin: simulated 0 is {Decimal(1577836800)} in the log" in notes
    assert "used: nodes have other names here: x y is x_y" in notes
    assert any("time in lines 2 and 3 is of two kinds" in note for note in notes)
    sent = table(tmp_path / "out", "transmissions.csv")
    assert sent.to_numpy().tolist() == [[0.25, "x_y"], [1.5, "x_y"]]


def test_a_run_directory_is_exported(tmp_path, capsys):
    scenario = SCENARIOS / "poisson_ring.toml"
    arguments = ["run", str(scenario), "--no-plot", "--set", "horizon=1.0", "--engine", "simpy"]
    assert main([*arguments, "--out", str(tmp_path / "run")]) == 0
    export = ["export", str(tmp_path / "run"), "--to", "log", "--out", str(tmp_path / "log")]
    (tmp_path / "log").mkdir()
    assert main(export) == 0
    assert {p.name for p in (tmp_path / "log").iterdir()} == {
        *("packets.csv", "ticks.csv", "scenario.toml"),
    }
    assert main(export) == 2
    assert "must be a new or empty folder" in capsys.readouterr().err


def test_a_message_without_a_time_of_arrival_is_lost(tmp_path):
    rows = ["seq,sender,receiver,time_sent,time_received", "0,a,b,1.0,1.25", "0,a,c,1.0,"]
    rows += ["1,a,b,2.0,NaN", "1,a,c,2.0,2.5"]
    netkf.import_log(write(tmp_path / "log.csv", rows), "csv", tmp_path / "out")
    outcomes = table(tmp_path / "out", "outcomes.csv").sort_values(["receiver", "message"])
    assert outcomes["delivered"].tolist() == [1, 0, 0, 1]
    run = netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml"), engine="simpy")
    events = run.events
    assert events[events["kind"] == "deliver"]["t"].tolist() == [1.25, 2.5]
    assert events[events["kind"] == "lost"]["t"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(("unit", "digits"), [("ms", 3), ("us", 6), ("ns", 9)])
def test_stamps_too_large_for_seconds_have_the_unit_of_their_size(tmp_path, unit, digits):
    stamps = [f"1700000000{'250000000'[:digits]}", f"1700000001{'5' + '0' * (digits - 1)}"]
    rows = ["timestamp,src,dst,seq,arrival", *(f"{t},a,b,{k},{t}" for k, t in enumerate(stamps))]
    log = write(tmp_path / "log.csv", rows)
    _, notes = netkf.import_log(log, "csv", tmp_path / "out")
    assert f"used: log.csv: timestamp is in {unit} since 1970, by its size" in notes
    assert "origin: simulated 0 is 1700000000 in the log" in notes
    assert table(tmp_path / "out", "transmissions.csv")["t"].tolist() == [0.25, 1.5]


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_a_log_may_come_through_a_pipe(tmp_path, pack):
    read, written = os.pipe()
    os.write(written, pack(b"t,src,dst\n1,a,b\n2,b,a\n"))
    os.close(written)
    netkf.import_log(f"/dev/fd/{read}", "csv", tmp_path / "out")
    os.close(read)
    assert table(tmp_path / "out", "transmissions.csv")["node"].tolist() == ["a", "b"]


def test_a_column_of_arrivals_may_be_empty(tmp_path):
    """It then tells nothing: each row is a message heard, as without the column."""
    rows = ["t,src,dst,seq,arrival", "1.0,a,b,0,", "2.0,a,b,1,"]
    with_it = write(tmp_path / "with.csv", rows)
    without = write(tmp_path / "without.csv", [row.rpartition(",")[0] for row in rows])
    netkf.import_log(with_it, "csv", tmp_path / "one")
    netkf.import_log(without, "csv", tmp_path / "other")
    for name in ("transmissions.csv", "outcomes.csv", "links.csv"):
        assert (tmp_path / "one" / name).read_text() == (tmp_path / "other" / name).read_text()


def test_a_column_of_arrivals_that_is_empty_in_one_file_tells_losses(tmp_path):
    (tmp_path / "log").mkdir()
    first, second = "t,src,dst,seq,arrival\n1.0,a,b,0,1.5\n", "t,src,dst,seq,arrival\n2.0,a,b,1,\n"
    write(tmp_path / "log" / "one.csv", first.splitlines())
    write(tmp_path / "log" / "two.csv", second.splitlines())
    netkf.import_log(tmp_path / "log", "csv", tmp_path / "out")
    assert table(tmp_path / "out", "outcomes.csv")["delivered"].tolist() == [1, 0]


def test_stamps_of_no_plausible_unit_are_refused(tmp_path):
    log = write(tmp_path / "log.csv", ["t,src,dst", "50000000000000,a,b"])
    with pytest.raises(ScenarioError, match=r"line 2: t is too large for seconds.*t_ns=t"):
        netkf.import_log(log, "csv", tmp_path / "out")


def test_readings_that_come_late_and_do_not_count_have_a_note(tmp_path):
    """So they do for no filter but block-intersection, and only in messages that take time."""
    (tmp_path / "robots.toml").write_text(ROBOTS)
    write(
        tmp_path / "speed.csv", ["t,node,u0", "1700000010000000000,a,1", "1700000010000000000,b,1"]
    )
    late = {"network.channel.delay": {"kind": "constant", "seconds": 0.02}}
    other = {"filter": {"kind": "block-belief-propagation", "estimates": "own"}}
    for changes, has_note in ((late, True), ({}, False), (late | other, False)):
        notes = netkf.load(tmp_path / "robots.toml", changes).notes
        assert any("in a message that took time" in note for note in notes) is has_note


ROBOTS = """
format = 1
name = "robots"
horizon = 4.0
probe = 1.0
[time]
origin = 1700000010
unit = "ns"
[[plants]]
name = "place"
nodes = ["a", "b"]
A = [[0.0]]
B = [[0.1]]
input = { kind = "recorded", path = "speed.csv", G = [[1.0]] }
cov = [[1.0]]
[[sensors]]
of = "place"
nodes = ["a", "b"]
H = [[1.0]]
R = [[1.0]]
sampling = { kind = "periodic", period = 1.0 }
[network]
graph = { kind = "edges", edges = [["a", "b"]], directed = false }
activation = { kind = "poisson", at = "nodes", rate = 1.0 }
[filter]
kind = "block-intersection"
"""


def test_a_log_counts_from_the_origin_of_the_scenario_that_it_is_like(tmp_path):
    """Stamps of the scenario's tables are nanoseconds, and two blocks read one of them."""
    (tmp_path / "robots.toml").write_text(ROBOTS)
    epoch = 1_700_000_010 * 10**9
    speeds = [f"{epoch + 5 * 10**8 * k},{node},{k}" for k in range(9) for node in "ab"]
    write(tmp_path / "speed.csv", ["t,node,u0", *speeds])
    sent = [(-1.5, "a", 0), (0.0, "a", 1), (0.5, "a", 2), (1.25, "b", 0), (2.5, "a", 3)]
    sent.append((5.0, "b", 1))
    lost = {2.5}
    rows = ["time,src,dst,seq,heard"]
    for t, node, k in sent:
        other = "b" if node == "a" else "a"
        rows.append(f"{epoch + round(t * 1e9)},{node},{other},{k},{int(t not in lost)}")
    log, like = write(tmp_path / "log.csv", rows), tmp_path / "robots.toml"
    _, notes = netkf.import_log(log, "csv", tmp_path / "out", like=like)
    assert "dropped: sent by [time] origin of the scenario: 2" in notes
    scenario = netkf.load(tmp_path / "out" / "scenario.toml")
    run = netkf.simulate(scenario, engine="simpy")
    events = run.events
    for kind, times in (("send", [0.5, 1.25, 2.5]), ("deliver", [0.5, 1.25]), ("lost", [2.5])):
        assert events[events["kind"] == kind]["t"].tolist() == times
    assert run.block("place", "b").P.tolist() == run.block("place", 1).P.tolist()
    with pytest.raises(ScenarioError, match="node: must be a node of the run; got 'c'"):
        run.block("place", "c")
    labels = run.plot("links").axes[0].get_yticklabels()
    assert [label.get_text() for label in labels] == ["a to b", "b to a"]
    # As a log and as a twin it comes back, from the same origin.
    netkf.export_log(run, tmp_path / "log")
    netkf.import_log(tmp_path / "log", "csv", tmp_path / "again")
    netkf.export_recorded(run, tmp_path / "twin")
    for name in ("again", "twin"):
        other = netkf.load(tmp_path / name / "scenario.toml")
        assert netkf.first_difference(run, netkf.simulate(other, engine="simpy")) is None
    text = ROBOTS.replace("1700000010", "1900000000")
    (tmp_path / "later.toml").write_text(text)
    with pytest.raises(ScenarioError, match=r"time.origin: must begin before the end of the log"):
        netkf.import_log(log, "csv", tmp_path / "no", like=tmp_path / "later.toml")
