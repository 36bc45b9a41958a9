"""What is said about promises is right for the scenario, and the same everywhere."""

import numpy as np
import pytest

import netkf
from netkf.runs.run import run_to_directory
from netkf.runs.summary import promise_traces
from netkf.runs.tables import format_with_error, summary_table
from netkf.theory.promises import compute_promises, promises_text
from tests.benchmarks.cases import load

UNSTABLE = {"kind": "diffusion", "A": [[0.5]], "B": [[1.0]], "cov": [[1.0]]}
ONE_WAY = {"loss": {"kind": "per-link"}, "symmetric": False}


def said(scenario, folder):
    """What `netkf theory` says about a scenario, and what the table of its run does."""
    # Which engine it was is not said, and this one needs no event loop for each filter.
    done = run_to_directory(scenario, folder / "out", engine="simpy")
    table = summary_table(done.summary, done.promised.limit_label, done.promised.notes)
    return promises_text(scenario, compute_promises(scenario)), table


def weighted(build, folder):
    (folder / "g.csv").write_text("sender,receiver,delivery_probability\n0,1,0.9\n1,0,0.3\n")
    return build(
        network={
            "graph": {"kind": "csv", "path": "g.csv"},
            "activation": {"kind": "poisson", "rate": 2.0},
            "channel": ONE_WAY,
        }
    )


def test_a_weighted_limit_is_not_called_S(build, tmp_path):
    for words in said(weighted(build, tmp_path), tmp_path):
        assert "weighted limit (not S of Tanwani's H(13))" in words
        assert "limit S" not in words


@pytest.mark.slow
def test_a_limit_without_the_delay_says_so(build, tmp_path):
    delay = {"network.channel.delay": {"kind": "constant", "seconds": 0.1}}
    for words in said(build().replace(delay), tmp_path):
        assert "limit S of Tanwani's H(13), if messages took no time" in words


def test_the_picture_uses_the_words_of_the_table(build, tmp_path):
    from matplotlib.figure import Figure

    from netkf.figures.figure_data import reduce_completed_run
    from netkf.figures.style import draw_covariances

    scenario = weighted(build, tmp_path)
    axes = Figure().add_subplot()
    completed = run_to_directory(scenario, tmp_path / "out", engine="simpy")
    draw_covariances(axes, reduce_completed_run(scenario, completed))
    assert "weighted limit (not S of Tanwani's H(13))" in axes.get_legend_handles_labels()[1]


def test_a_mismatched_model_is_named_beside_the_bound(build, tmp_path):
    note = "the filters' model differs from the truth"
    for words in said(build().replace({"filter.model.R": [[1.0]]}), tmp_path):
        assert note in words
    for words in said(build(), tmp_path / "same"):
        assert note not in words


def test_a_missing_steady_state_is_named_by_the_run(build, tmp_path):
    """The threshold for one blind node is rate 2 a / epsilon = 2."""
    for rate, missing in ((1.7, True), (2.5, False)):
        scenario = build(
            plant=UNSTABLE,
            network={
                "graph": {"kind": "path", "nodes": 2},
                "activation": {"kind": "poisson", "rate": rate},
            },
        )
        _, table = said(scenario, tmp_path / str(rate))
        assert ("no steady state" in table) == missing


def test_a_node_that_sees_nothing_does_not_hide_the_steady_state_of_another(build, tmp_path):
    scenario = build(plant=UNSTABLE, filter={"kind": "local"})
    found = compute_promises(scenario)
    # 0 = 2 a P + 1 - P^2 / R with a = R = 0.5

    P = np.roots([-2.0, 1.0, 1.0]).max()

    assert found["steady_bound"]["trace"] == [pytest.approx(P), None]
    assert found["steady_bound"]["reason"].endswith("node 1 alone has no steady state")
    assert "does not talk" in found["limit_covariance"]["reason"]
    for words in said(scenario, tmp_path):
        assert "no steady state" in words
    with pytest.raises(netkf.TheoryError, match="the filter does not talk"):
        netkf.theory.steady_covariance_bound(scenario)


def test_what_a_record_does_not_tell_is_unknown_not_wrong(build, tmp_path):
    (tmp_path / "ticks.csv").write_text("t,node,peer\n0.5,0,1\n")
    clock = {"kind": "recorded", "path": "ticks.csv"}
    scenario = build(network={"graph": {"kind": "path", "nodes": 2}, "activation": clock})
    rows = netkf.theory.assumptions(scenario).set_index("assumption")
    for name in ("the rates of all links are positive", "all links have one rate"):
        assert rows.holds[name] is None
        assert "does not tell its rates" in rows.evidence[name]
    assert not rows.holds["the link clocks are independent Poisson processes"]
    assert not rows.evidence.str.contains("RecordedClock").any()
    text = promises_text(scenario, compute_promises(scenario))
    assert "  unknown  the rates of all links are positive" in text
    with pytest.raises(netkf.TheoryError, match="not known beforehand"):
        netkf.theory.limit_covariance(scenario)


def test_rates_are_shown_as_they_are(ring):
    uneven = ring.replace({"network.activation.rates": [[0, 1, 5.0]]})
    for scenario, words in ((ring, "2 per second on every link"), (uneven, "2 .. 5 per second")):
        rows = netkf.theory.assumptions(scenario).set_index("assumption")
        assert rows.evidence["all links have one rate"].startswith(words)


def test_a_run_with_samples_at_known_times_says_that_its_bound_has_a_cycle():
    sampled = {"sensors.0.sampling": {"kind": "periodic", "period": 0.5}, "horizon": 2.0}
    scenario = load("poisson_ring").replace(sampled)
    promised = promise_traces(scenario, scenario.times)
    assert promised.bound is not None
    assert promised.notes[0] == (
        "steady state of the bound: samples at known times lead to a cycle, not to a steady state"
    )


def test_tables_say_nothing_of_a_paper_that_is_not_about_the_filter(build, tmp_path):
    words, table = said(build(filter={"kind": "covariance-intersection", "epsilon": 0.3}), tmp_path)
    assert "at 3 s" in words
    assert table.splitlines()[0].split()[-3:] == ["bound", "ratio", "NEES"]
    other = tmp_path / "other"
    other.mkdir()
    sampling = {"kind": "periodic", "period": 0.5}
    sensors = [{"nodes": [0], "H": [[1.0]], "R": [[0.5]], "sampling": sampling}]
    gossip = build(sensors=sensors, filter={"kind": "gossip"})
    words, table = said(gossip, other)
    assert "H(" not in words + table
    assert table.splitlines()[0].split() == ["node", "RMS", "error", "mean", "trace", "P", "NEES"]
    assert "bound" not in table


def test_a_long_table_lists_the_worst_first():
    keys = ("mean_trace", "bound", "ratio", "mean_nees")
    nodes = [{"node": k, "rms_error": float(k % 37), **dict.fromkeys(keys)} for k in range(40)]
    messages = {"sent": 0, "delivered": 0, "lost": 0, "in_flight": 0}
    summary = {"nodes": nodes, "overall": nodes[0], "limit": None, "central": None, "notes": []}
    lines = summary_table({**summary, "bound": "", "messages": messages}).splitlines()[2:33]
    errors = [float(line.split()[1]) for line in lines if "more" not in line]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] == 36.0
    for row in nodes:  # without a truth the largest covariances come first
        row |= {"rms_error": None, "mean_trace": float(row["node"])}
    lines = summary_table({**summary, "bound": "", "messages": messages}).splitlines()[2:33]
    assert [line.split()[0] for line in lines[:2]] == ["39", "38"]


def test_intervals_of_ten_and_more_are_plain_numbers():
    assert format_with_error(478.2, 9.7) == "478.2 +- 10"
    assert format_with_error(0.031, 0.0012) == "0.031 +- 0.001"
