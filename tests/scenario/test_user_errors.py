"""Mistakes in users' classes: one line that names the class, the method, the file and the line."""

# ruff: noqa: E501

import importlib
import re
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

import netkf
from netkf import parts
from netkf.cli.main import main
from netkf.kernels import Kernels, Record, kernel
from netkf.linalg.plain import is_plain
from netkf.testing import check_channel, check_clock, check_filter, check_sensor

HEAD = "from dataclasses import dataclass\nimport numpy as np\nfrom netkf.parts import *\n"
START = """
format = 1
name = "own"
horizon = 2.0
probe = 1.0
"""
SLOTS = (
    START
    + """
plant = { kind = "linear", F = [[0.9]], Q = [[1.0]], period = 1.0, cov = [[1.0]] }
sensors = [SENSOR]
network = { graph = { GRAPH }, activation = { kind = "broadcast" } }
filter = { FILTER }
"""
)
CLOCKS = (
    START
    + """
plant = { PLANT, A = [[-0.1]], B = [[1.0]], cov = [[1.0]] }
sensors = [{ nodes = [0], H = [[1.0]], R = [[0.5]], sampling = { kind = "periodic", period = 0.5 } }]
network = { graph = { GRAPH }, activation = { CLOCK }, channel = { CHANNEL } }
filter = { FILTER }
"""
)
PARTS = {
    "SENSOR": "{ nodes = [0], H = [[1.0]], R = [[0.5]] }",
    "GRAPH": 'kind = "cycle", nodes = 3',
    "FILTER": 'kind = "hybrid", epsilon = 0.3',
    "PLANT": 'kind = "diffusion"',
    "CLOCK": 'kind = "poisson", rate = 5.0, at = "nodes"',
    "CHANNEL": "",
}
SAME = "def absorb(self, state, messages, exchange): return state"
WEIGHTS = f"link_weights = property(lambda self: Weights(of=self.weight))\n{SAME}"
NEEDED = {
    "FILTER": ('kind = "{}"', "Filter"),
    "SENSOR": ('{{ nodes = [0], R = [[0.5]], kind = "{}" }}', "NonlinearSensor"),
    "GRAPH": ('kind = "{}", nodes = 3', "Cycle"),
    "CLOCK": ('kind = "{}", rate = 5.0, at = "nodes"', "Poisson"),
    "LOSS": ('loss = {{ kind = "{}", delivery = 0.5 }}', "Bernoulli"),
    "DELAY": ('delay = {{ kind = "{}" }}', "Delay"),
    "PLANT": ('kind = "{}"', "Diffusion"),
}
NO_RESULT = "returned nothing; it must return a value"
MISTAKES = {
    "absorb takes too little": ("FILTER", "def absorb(self, state, messages): return state",
                                r"F\.absorb \(FILE, line 6\) must take \(state, messages, exchange\)"),
    "absorb returns nothing": ("FILTER", "def absorb(self, state, messages, exchange): pass",
                               rf"F\.absorb \(FILE, line 6\) {NO_RESULT}"),
    "absorb fails": ("FILTER", "def absorb(self, state, messages, exchange):\n    return state.foo",
                     r"F failed in absorb: AttributeError: 'State' object.*; FILE, line 7"),
    "a helper of absorb fails": (
        "FILTER", "def absorb(self, state, messages, exchange):\n    return [1 / 0 for _ in 'ab']",
        r"F failed in absorb: ZeroDivisionError.*; FILE, line 7"),
    "a file of absorb is missing": (
        "FILTER", "def absorb(self, state, messages, exchange): return open('gone.csv')",
        r"F failed in absorb: FileNotFoundError: .*gone.csv.*; FILE, line 6"),
    "an error of its own": (
        "FILTER", "class Far(Exception):\n    def __init__(self, a, b): super().__init__(f'{a} of {b}')\n"
        "def absorb(self, state, messages, exchange): raise self.Far(1, 2)",
        r"F failed in absorb: Far: 1 of 2; FILE, line 8"),
    # Node 0 has a reading; the others, whose absorb is called after, return what they should.
    "absorb returns an xhat of another shape": (
        "FILTER", "def absorb(self, state, messages, exchange):\n"
        "    return state._replace(xhat=np.ones(2)) if state.xhat[0] else state",
        r"F failed after absorb \(FILE, line 6\) returned State\(xhat=array\(\[1\., 1\.\]\)"),
    "absorb returns a number": ("FILTER", "def absorb(self, state, messages, exchange): return 3",
                                r"F failed after absorb \(FILE, line 6\) returned 3: "),
    "update takes too little": ("FILTER", f"def update(self, state): return state\n{SAME}",
                                r"F\.update \(FILE, line 6\) must take \(state, reading\), not \(state\)"),
    "update returns nothing": ("FILTER", f"def update(self, state, reading): pass\n{SAME}",
                               rf"F\.update \(FILE, line 6\) {NO_RESULT}"),
    "predict returns nothing": ("FILTER", f"def predict(self, state, gap): pass\n{SAME}",
                                rf"F\.predict \(FILE, line 6\) {NO_RESULT}"),
    "init returns nothing": ("FILTER", f"def init(self, model, mean, cov, node): pass\n{SAME}",
                             rf"F\.init \(FILE, line 6\) {NO_RESULT}"),
    "emit returns the state only": ("FILTER", f"def emit(self, state, exchange): return state\n{SAME}",
                                    r"F\.emit \(FILE, line 6\) must return a tuple of 2, not State"),
    "estimate returns nothing": ("FILTER", f"def estimate(self, state): pass\n{SAME}",
                                 rf"F\.estimate \(FILE, line 6\) {NO_RESULT}"),
    "estimate returns a column": ("FILTER", f"def estimate(self, state): return state.xhat[:, None], None\n{SAME}",
                                  r"F failed after estimate \(FILE, line 6\) returned .*: xhat must be numbers of the "
                                  r"shape \(1,\); got float64 of the shape \(1, 1\)"),
    "emit returns no state": ("FILTER", f"def emit(self, state, exchange): return None, state.xhat\n{SAME}",
                              r"F\.emit \(FILE, line 6\) must return a value before the others, not \(None, "),
    "a timing that is a table": ("FILTER", f"timing = {{'talks': True}}\n{SAME}", r"F\.timing: must be Timing; got \{"),
    "weight fails": ("FILTER", f"def weight(self, *degrees): return 1 / 0\n{WEIGHTS}",
                     r"F failed in weight: ZeroDivisionError.*; FILE, line 6"),
    "weights beyond 1": ("FILTER", f"link_weights = Weights(of=lambda *degrees: 5.0)\n{SAME}",
                         r"F\.link_weights\.of: must be a finite number .*; got 5\.0"),
    "a schedule that is a text": ("FILTER", f"timing = Timing(schedule='exchange')\n{SAME}",
                                  r'F\.timing\.schedule: must be None or a tuple of "predict", "sense", "exchange"; got'),
    "half a step": ("FILTER", f"timing = Timing(steps=lambda phase: 2.5)\n{SAME}", r"F\.timing\.steps: must return a whole number of at least 0"),
    "an age that is a text": ("FILTER", f"timing = Timing(max_age='x')\n{SAME}", r"F\.timing\.max_age: must be a number"),
    "notes fail": ("FILTER", f"needs = Needs(notes=lambda scenario: 1 / 0)\n{SAME}",
                   r"F failed in needs: ZeroDivisionError.*; FILE, line 6"),
    "payload numbers are a text": ("FILTER", f"analysis = Analysis(payload_numbers=lambda *sizes: 'x')\n{SAME}",
                                   r"F\.analysis\.payload_numbers: must be a finite number at least 0; got 'x'"),
    "weight is a text": ("FILTER", f"def weight(self, *degrees): return 'x'\n{WEIGHTS}",
                         r"F\.link_weights\.of: must be a finite number at least 0 and at most 1; got 'x'"),
    "absorb exits": ("FILTER", "def absorb(self, state, messages, exchange): raise SystemExit(3)",
                     r"F\.absorb \(FILE, line 6\) called exit"),
    "it cannot be made": ("FILTER", f"def __post_init__(self): raise RuntimeError('no')\n{SAME}",
                          r"F could not be made \(RuntimeError: no; FILE, line 6\)"),
    "nothing is defined": ("FILTER", "pass", "must define absorb"),
    "h returns nothing": ("SENSOR", "def h(self, x, node): pass\n"
                          "def jacobian(self, x, node): return np.eye(1)",
                          rf"F\.h \(FILE, line 6\) {NO_RESULT}"),
    "h takes too little": ("SENSOR", "def h(self, x): return x\n"
                           "def jacobian(self, x, node): return np.eye(1)",
                           r"F\.h \(FILE, line 6\) must take \(x, node\), not \(x\)"),
    "jacobian fails": ("SENSOR", "def h(self, x, node): return x\n"
                       "def jacobian(self, x, node): return x[5]",
                       r"F failed in jacobian: IndexError.*; FILE, line 7"),
    "h is nan": ("SENSOR", "def h(self, x, node): return np.array([np.nan])\n"
                 "def jacobian(self, x, node): return np.eye(1)",
                 r"F failed after h \(FILE, line 6\) returned \[nan\]: .*h must return finite numbers of the shape \(1,\)"),
    "a jacobian of another width": ("SENSOR", "def h(self, x, node): return x\n"
                                    "def jacobian(self, x, node): return np.ones((1, 2))",
                                    r"jacobian must return finite numbers of the shape \(1, 1\), not \[\[1\.0, 1\.0\]\]"),
    "a complex h": ("SENSOR", "def h(self, x, node): return x + 1j\n"
                    "def jacobian(self, x, node): return np.eye(1)", r"h must return finite numbers .* at x = \["),
    "a difference that is nan": ("SENSOR", "def h(self, x, node): return x\n"
                                 "def jacobian(self, x, node): return np.eye(1)\n"
                                 "def difference(self, y, expected): return y * np.nan",
                                 r"F failed after difference .* difference must return finite numbers of the shape \(1,\), not \[nan\]"),
    "a sensor defines half": ("SENSOR", "def h(self, x, node): return x", "must define jacobian"),
    "a sensor defines nothing": ("SENSOR", "pass", "must define h, jacobian"),
    "build returns nothing": ("GRAPH", "def build(self, seed): pass",
                              rf"F\.build \(FILE, line 6\) {NO_RESULT}"),
    "build fails": ("GRAPH", "def build(self, seed): return 1 / 0",
                    r"F failed in build: ZeroDivisionError.*; FILE, line 6"),
    "mean_rate fails": ("CLOCK", "def mean_rate(self, entity): raise KeyError('x')",
                        r"F failed in mean_rate: KeyError: 'x'.*; FILE, line 6"),
    "mean_rate takes nothing": ("CLOCK", "def mean_rate(self): return 1.0",
                                r"F\.mean_rate \(FILE, line 6\) must take \(entity\), not \(\)"),
    "check of a loss fails": ("LOSS", "def check(self, topology): return 1 / 0",
                              r"F failed in check: ZeroDivisionError.*; FILE, line 6"),
    "mean_delivery returns nothing": ("LOSS", "def mean_delivery(self, sent): pass",
                                      rf"F\.mean_delivery \(FILE, line 6\) {NO_RESULT}"),
    "draw fails": ("DELAY", "def draw(self, random): return 1 / 0",
                   r"F failed in draw: ZeroDivisionError.*; FILE, line 6"),
    "draw takes nothing": ("DELAY", "def draw(self): return 1.0",
                           r"F\.draw \(FILE, line 6\) must take \(.+\), not \(\)"),
    "draw is negative": ("DELAY", "def draw(self, random): return -1.0",
                         r"delay\.F\.draw: must be a finite number at least 0; got -1\.0"),
    "draw is not a number": ("DELAY", "def draw(self, random): return float('nan')", r"F\.draw: must be a finite .*got nan"),
    "draw never ends": ("DELAY", "def draw(self, random): return float('inf')", r"F\.draw: must be a finite .*got inf"),
    "a message never arrives": (
        "DELAY", "def draw(self, random): return 0.1\n"
        "def message_delay(self, sent, drawn): return float('inf')",
        r"F: the delay of message 0 on link .* must be finite and not negative; got inf"),
    "a fixed delay that is a text": ("DELAY", "fixed = '0.5'\ndef draw(self, random): return 0.5",
                                     r"F\.fixed: must be a finite number at least 0, or None; got '0\.5'"),
    "a share beyond 1": ("LOSS", "fate_share = 1.5", r"F\.fate_share: must be a finite number .*; got 1\.5"),
    "a state of nobody": ("LOSS", "state_of = 'node'", r'F\.state_of: must be one of "link", "sender"; got .node'),
    "a complex probability": ("LOSS", "def delivery_probability(self, sent): return 0.5 + 0.0j",
                              r"loss: F\.delivery_probability must return a number, not \(0\.5\+0j\)"),
    "a deterministic half": ("LOSS", "deterministic = True", r"must be 0 or 1 where deterministic is True; got 0\.5"),
    "a state that is a number": ("LOSS", "stateful = True\ndef next_state(self, link, bad, random): return 0.3",
                                 r"F\.next_state must return True or False, not 0\.3"),
    "a negative rate": ("CLOCK", "def mean_rate(self, entity): return -1.0",
                        r"activation\.F\.mean_rate: must be a finite number at least 0; got -1\.0"),
    "complex ticks": ("CLOCK", "def ticks(self, entity, origin, index, now, random, count): return np.array([1j])",
                      r"activation: F\.ticks must return a vector of times, not \["),
    "a plant returns no truth": ("PLANT", "def sampled_truth(self, *arguments): pass",
                                 rf"F\.sampled_truth \(FILE, line 6\) {NO_RESULT}"),
    "a misspelled verb": ("FILTER", f"def upate(self, state, reading): return state\n{SAME}",
                          r"F\.upate \(FILE, line 6\) is never called: did you mean update\?"),
    "a need outside needs": ("FILTER", f"inverts = True\n{SAME}",
                             r"F\.inverts is never read: state it in needs, as Needs\(inverts=\.\.\.\)"),
    "a misspelled need": ("FILTER", f"invert: bool = True\n{SAME}", r"F\.invert is never read: .*Needs\(inverts"),
    "weights outside link_weights": (
        "FILTER", "def weight(self, degree, peer): return 0.1\n"
        "def absorb(self, state, messages, exchange): return [state for m in messages if m.weight][0]",
        r"F\.weight \(FILE, line 6\) is never called: state it in link_weights, as Weights\("),
    "an age outside a timing": (
        "FILTER", f"max_age = 3.0\ntiming = property(lambda self: Timing(max_age=2.0))\n{SAME}",
        r"F\.max_age is never read: state it in timing, as Timing\(max_age=\.\.\.\)"),
    "a setting that nothing reads": (
        "FILTER", f"max_age: float = setting(positive, default=3.0)\n{SAME}",
        r"F\.max_age is never read: state it in timing"),
    "a timing that is a method": ("FILTER", f"def timing(self): return Timing()\n{SAME}",
                                  r"F\.timing \(FILE, line 6\) must be a value or a property; write @property"),
    "a verb that is no method": ("FILTER", "absorb = 3", r"F\.absorb must be a method, not 3"),
    "a misspelled h": ("SENSOR", "def jacobain(self, x, node): return x",
                       r"F\.jacobain \(FILE, line 6\) is never called: did you mean jacobian\?"),
    "a misspelled build": ("GRAPH", "def biuld(self, seed): return 0",
                           r"F\.biuld \(FILE, line 6\) is never called: did you mean build\?"),
    "a method for a setting": ("CLOCK", "def rate(self): return 3.0",
                               r"F\.rate \(FILE, line 6\) is never called, it has the name of a setting"),
    "a misspelled rate": ("CLOCK", "@property\ndef mean_rates(self): return 3.0",
                          r"F\.mean_rates is never read: did you mean mean_rate\?"),
    "a law that is a method": ("CLOCK", "def gaps(self): return None",
                               r"F\.gaps \(FILE, line 6\) must be a value or a property"),
    "a misspelled property of a loss": ("LOSS", "independant = False",
                                        r"F\.independant is never read: did you mean independent\?"),
    "a law's number outside the law": ("DELAY", "def cdf(self, t): return t\ndef draw(self, random): return 1.0",
                                       r"F\.cdf \(FILE, line 6\) is never called: state it in law, as WaitingLaw\(cdf"),
    "a state that is never asked for": (
        "LOSS", "def next_state(self, link, bad, random): return random.random() < 0.5",
        r"F\.next_state \(FILE, line 6\) is never called where stateful is False"),
    "a misspelled start": ("PLANT", "def start_meen(self): return np.zeros(1)",
                           r"F\.start_meen \(FILE, line 6\) is never called: did you mean start_mean\?"),
}  # fmt: skip


def write(folder, name, part, body):
    module = f"own_{abs(hash(name))}"
    base = NEEDED[part][1]
    source = f"{HEAD}@dataclass(frozen=True, eq=False)\nclass F({base}):\n"
    (folder / f"{module}.py").write_text(source + textwrap.indent(body, "    ") + "\n")
    return module


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", MISTAKES)
def test_one_line_names_class_method_file_and_line(name, tmp_path, monkeypatch, capsys):
    part, body, words = MISTAKES[name]
    module = write(tmp_path, name, part, body)
    monkeypatch.chdir(tmp_path)
    text = NEEDED[part][0].format(f"{module}:F")
    key = "CHANNEL" if part in ("LOSS", "DELAY") else part
    pattern = words.replace("FILE", rf"{module}\.py")
    for template in (SLOTS, CLOCKS):
        if key not in template:
            continue
        values = {**PARTS, key: text}
        if template is SLOTS and part != "FILTER":
            values["FILTER"] = 'kind = "kcf", epsilon = 0.1'
        table = template
        for one, value in values.items():
            table = re.sub(rf"\b{one}\b", lambda _, value=value: value, table)
        (tmp_path / "own.toml").write_text(table)
        for engine in ("simpy", "auto"):
            out = str(tmp_path / f"out{engine}{template is SLOTS}")
            arguments = [
                "run",
                "own.toml",
                "--trust",
                "--no-plot",
                "--engine",
                engine,
                "--out",
                out,
            ]
            assert main(arguments) == 2
            printed = capsys.readouterr().err
            lines = [line for line in printed.splitlines() if "compiling" not in line]
            assert len(lines) == 1, printed
            assert re.search(pattern, lines[0]), lines[0]
            # What a summary or a command asks for, no simulation does.
            if "mean_delivery" not in body and "notes" not in body:
                with pytest.raises(netkf.NetkfError, match=pattern):
                    netkf.simulate(netkf.load("own.toml"), engine=engine)
            if "must define" in words or "must take" in words:
                with pytest.raises(netkf.ScenarioError, match=pattern):
                    netkf.load("own.toml")


@dataclass(frozen=True, eq=False)
class Odd(parts.Bernoulli):
    def mean_delivery(self, sent):
        return 2.0


@dataclass(frozen=True, eq=False)
class Skew(parts.Filter):
    def absorb(self, state, messages, exchange):
        return state

    def estimate(self, state):
        return state.xhat, state.root @ state.root.T + np.triu(np.ones((2, 2)), 1)


@dataclass(frozen=True, eq=False)
class Half(parts.Delay):
    def draw(self, random):
        return np.float32(0.5)


plant = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0}
network = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}}


def test_what_only_theory_asks_for_is_held_to_its_rule(ring):
    scenario = ring.replace({"network.channel.loss": Odd(0.5)})
    with pytest.raises(netkf.ScenarioError, match=r"loss\.Odd\.mean_delivery: must be .*got 2\.0"):
        netkf.theory.assumptions(scenario)


@dataclass(frozen=True, eq=False)
class Rows(parts.Filter):
    """Says that it is affine, and does not take several columns."""

    analysis = parts.Analysis(affine=True)
    shift = parts.Filter.shift

    def absorb(self, state, messages, exchange):
        return state._replace(xhat=state.xhat + np.ones(2) * (state.xhat[0] - state.xhat[0]))


@dataclass(frozen=True, eq=False)
class Silent(parts.Bernoulli):
    def mean_delivery(self, sent):
        return 1 / 0


@dataclass(frozen=True, eq=False)
class Stopped(parts.Poisson):
    def ticks(self, entity, origin, index, now, random, count):
        return 1 / 0


@dataclass(frozen=True, eq=False)
class Blank(parts.RangeSensor):
    def matrix_of(self, n):
        return 1 / 0


def test_studies_name_the_class_that_they_call(ring):
    lossy = ring.replace({"network.channel.loss": Silent(delivery=0.5)})
    sensors = {"sensors[0].sampling": Stopped(rate=1.0)}
    blank = Blank(nodes=(0,), R=[[0.5]], positions=[[1.0, 0.0]], sampling=parts.Poisson(rate=1.0))
    for call, words in (
        (lambda: netkf.compare_filters(lossy, ["local"], runs=2), "Silent failed in mean_delivery"),
        (lambda: netkf.log_likelihood(ring.replace(sensors)), "Stopped failed in ticks"),
        (lambda: netkf.fit_noise(ring.replace(sensors)), "Stopped failed in ticks"),
        (
            lambda: netkf.monte_carlo(ring.replace({"sensors": [blank]}), 2, workers=1),
            "Blank failed in matrix_of",
        ),
    ):
        with pytest.raises(netkf.EngineError, match=words):
            call()


@dataclass(frozen=True, eq=False)
class WithoutInit(parts.Bernoulli):
    def __init__(self, share):
        object.__setattr__(self, "share", share)


@dataclass(frozen=True, eq=False)
class WithoutPostInit(parts.LinearSensor):
    def __post_init__(self):
        pass


def test_classes_that_do_not_call_super_are_told(ring):
    loss, sensor = WithoutInit(0.5), WithoutPostInit(nodes=[0], H=[[1.0, 0.0]], R=[[0.5]])
    words = "has settings that nobody checked; let its __init__ or __post_init__ call that of super"
    for change, part, check in (
        ("network.channel.loss", loss, check_channel),
        ("sensors", [sensor], check_sensor),
    ):
        with pytest.raises(netkf.ScenarioError, match=rf"{change}.*: WithoutI?P?.*{words}"):
            ring.replace({change: part})
        with pytest.raises(AssertionError, match=words):
            check(part if part is loss else sensor)


@dataclass(frozen=True, eq=False)
class Chosen(parts.Poisson):
    def entities(self, topology):
        return ((0,),)


@dataclass(frozen=True, eq=False)
class Startless(parts.Diffusion):
    start_mean = None


def test_what_no_engine_would_ask_and_values_of_plants_are_told(ring):
    with pytest.raises(netkf.ScenarioError, match=r"Chosen\.entities is never called: at says who"):
        ring.replace({"network.activation": Chosen(rate=1.0, at="nodes")})
    with pytest.raises(netkf.ScenarioError, match=r"Startless\.start_mean: must be a vector"):
        ring.replace({"plant": Startless(A=ring.plant.A, B=ring.plant.B)})


def test_theory_names_the_class_that_it_calls(ring):
    sampling = {"kind": "periodic", "period": 0.5}
    scenario = ring.replace({"filter": Rows(), "horizon": 2.0, "sensors.0.sampling": sampling})
    run = netkf.simulate(scenario)
    with pytest.raises(
        netkf.EngineError, match=r"Rows failed in absorb: ValueError: operands .*; .*, line"
    ):
        netkf.theory.error_covariance(scenario, run)


def test_a_covariance_that_is_not_symmetric_ends_a_run(ring):
    with pytest.raises(
        netkf.EngineError, match=r"Skew failed after estimate .* P must be symmetric"
    ):
        netkf.simulate(ring.replace({"filter": Skew()}))


@dataclass(frozen=True, eq=False)
class Early(parts.LinearSensor):
    def sample_times(self, node, ordinal, generator, horizon):
        return np.array([-1.0, 0.5])


@dataclass(frozen=True, eq=False)
class Bigamy(parts.Matching):
    protocol: str = "one-edge"

    def draw(self, topology, random):
        return [(0, 1), (1, 2)]


RECORDS = {
    "nothing": None,
    "x": {"node": {"a": "x"}},
    "-2": {"payload": {"a": (-2,)}},
    "abc": {"settings": {"a": "abc"}},
}


@dataclass(frozen=True, eq=False)
class Misshapen(parts.Filter):
    what: str = parts.setting(parts.text)

    kernels = Kernels(lambda own, *_: RECORDS[own.what] and Record(**RECORDS[own.what]))


@pytest.mark.parametrize("what", RECORDS)
def test_what_is_no_record_or_kernel_is_told(what, ring):
    words = rf"Misshapen failed.*TypeError: (Kernels.record must return a Record|Record\.\w+\['a'\] must be.*{what})"
    for engine in ("simpy", "compiled"):
        with pytest.raises(netkf.EngineError, match=words):
            netkf.simulate(ring.replace({"filter": Misshapen(what)}), engine=engine)
    with pytest.raises(TypeError, match=r"Kernels\.absorb must be a kernel .*, not 3"):
        Kernels(absorb=3)


@pytest.mark.parametrize(
    "tables",
    [
        {"node": {"memory": ()}},
        {"link": {"view": ()}},
        {"payload": {"two words": ()}},
        {"settings": {"xhat": 1.0}},
        {"node": {"a": ()}, "scratch": {"a": ()}},
    ],
)
def test_names_that_mean_something_else_in_a_record_are_refused(tables):
    with pytest.raises(TypeError, match=r"Record: \S.* must be a name that nothing else in a r"):
        Record(**tables)


@kernel
def mute(record, h, m, run):
    run.sends[0] = 0


class Mute(parts.Filter):
    kernels = Kernels(emit=mute)


@kernel
def positive(x):
    assert x > 0.0
    return x


@kernel
def raising(record, h, run):
    record.xhat[h, 0, 0] = positive(record.xhat[h, 0, 0])


class Raising(parts.Filter):
    kernels = Kernels(absorb=raising)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_kernel_that_raises_is_refused(ring, engine):
    """The exception was ignored, and the run went on to its end."""
    with pytest.raises(
        netkf.EngineError, match=r"a kernel must not raise \(.*errors.py, line \d+\)"
    ):
        netkf.simulate(ring.replace({"filter": Raising()}), engine=engine)


@kernel
def misspelled(record, h, run):
    record.xhat[h, 0, 0] = record.xhta[h, 0, 0]  # a line that the message names


@kernel
def unknown(record, h, run):
    record.xhat[h, 0, 0] = nowhere  # noqa: F821


@kernel
def texts(record, h, run):
    record.xhat[h, 0, 0] = len(str(record.xhat[h, 0, 0]) + "x")


@kernel
def shouting(message, settings, t, out):
    out[0] = loudness  # noqa: F821


@kernel
def short(message, out):
    out[0] = 1.0


@dataclass(frozen=True, eq=False)
class Uncompiled(parts.Filter):
    verb: str = parts.setting(parts.text)

    kernels = property(lambda self: Kernels(absorb=globals()[self.verb]))


@dataclass(frozen=True, eq=False)
class Shouting(parts.KernelLoss):
    law = shouting


@dataclass(frozen=True, eq=False)
class Short(parts.KernelLoss):
    law = short


class Swing:
    kernels = (short, short)


COMPILED = {
    "misspelled": r"Unknown attribute 'xhta' of type \w*record;",
    "unknown": r"NameError: name 'nowhere' is not defined",
    "texts": r"No implementation of function .*: \S",
}


@pytest.mark.skipif(is_plain(), reason="nothing is compiled")
@pytest.mark.parametrize("verb", COMPILED)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_what_cannot_be_compiled_is_told_in_one_line_with_its_place(verb, engine, ring):
    """The compiler's own text was cut after 300 characters, mostly before the place."""
    place = r"cannot be compiled \(\S*test_user_errors\.py, line \d+\): "
    with pytest.raises(netkf.EngineError, match=place + COMPILED[verb]) as caught:
        netkf.simulate(ring.replace({"filter": Uncompiled(verb)}), engine=engine)
    assert "\n" not in str(caught.value)
    if engine == "simpy":
        with pytest.raises(AssertionError, match=rf"absorb: failed: .* {place}{COMPILED[verb]}"):
            check_filter(Uncompiled(verb))


@kernel
def printing(record, h, run):
    print("here")


@pytest.mark.skipif(is_plain(), reason="nothing is compiled")
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_kernel_that_prints_is_refused(engine, ring):
    """It takes the lock that the run has given away, and some runs waited for it forever."""
    with pytest.raises(netkf.EngineError, match=r"must not print \(\S*errors.py, line \d+\): set"):
        netkf.simulate(ring.replace({"filter": Uncompiled("printing")}), engine=engine)


@kernel
def loud(message, settings, t, out):
    print("here")
    out[0] = 1.0


@dataclass(frozen=True, eq=False)
class Loud(parts.KernelLoss):
    law = loud


@pytest.mark.skipif(is_plain(), reason="nothing is compiled")
def test_a_law_that_prints_is_refused(ring):
    with pytest.raises(netkf.EngineError, match=r"must not print \(\S*errors.py, line \d+\)"):
        netkf.simulate(ring.replace({"network.channel.loss": Loud()}), engine="simpy")


def test_kernels_must_take_what_they_are_given(ring):
    with pytest.raises(TypeError, match=r"absorb must take \(record, h, run\), not \(message, out"):
        Kernels(absorb=short)
    words = r"loss: Short\.law must take \(message, settings, t, out\), not \(message, out\)"
    with pytest.raises(netkf.ScenarioError, match=words):
        netkf.simulate(ring.replace({"network.channel.loss": Short()}), engine="simpy")
    plant = {"f": Swing, "B": [[1.0]], "step": 0.1}
    with pytest.raises(netkf.ScenarioError, match=r"kernel f must take \(x, u, t, out\), not"):
        parts.NonlinearDiffusion(**plant)
    Swing.kernels = (short,)
    with pytest.raises(netkf.ScenarioError, match="must have a pair of kernels"):
        parts.NonlinearDiffusion(**plant)
    if not is_plain():
        with pytest.raises(netkf.EngineError, match=r"kernel shouting cannot be .* 'loudness' is"):
            netkf.simulate(ring.replace({"network.channel.loss": Shouting()}), engine="simpy")


def test_a_kernel_that_is_silent_without_saying_so_is_told():
    """SimPy sent nothing, and the compiled engine did not ask."""
    with pytest.raises(AssertionError, match=r"run.sends: write Kernels\(decides=True\)"):
        check_filter(Mute())


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_what_would_lead_kernels_astray_is_refused(engine, ring, build):
    """Times before 0 ended the process, and a node in two pairs swapped its state twice."""
    sensor = Early(nodes=(0,), H=[[1.0, 0.0]], R=[[1.0]], sampling=parts.Poisson(rate=1.0))
    with pytest.raises(netkf.ScenarioError, match=r"Early\.sample_times must return times of at l"):
        netkf.simulate(ring.replace({"sensors": (sensor,)}), engine=engine)
    plant = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0}
    network = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "matching", "protocol": "one-edge"},
    }
    scenario = build(plant=plant, network=network, filter={"kind": "gossip"}, probe=1.0)
    with pytest.raises(
        netkf.ScenarioError, match=r"Bigamy\.draw must return links .* no node twice"
    ):
        netkf.simulate(scenario.replace({"network.activation": Bigamy()}), engine=engine)


def test_float32_delays_are_numbers_in_both_engines(build):
    scenario = build(plant=plant, network=network, filter={"kind": "diffusion"}, probe=1.0)
    scenario = scenario.replace({"network.channel.delay": Half()})
    one, other = (netkf.simulate(scenario, engine=engine) for engine in ("simpy", "compiled"))
    assert one.events.equals(other.events)
    assert (one.events.kind == "deliver").any()


CHECKERS = {"FILTER": check_filter, "LOSS": check_channel, "CLOCK": check_clock,
            "SENSOR": check_sensor}  # fmt: skip


@pytest.mark.parametrize("name", ["absorb fails", "absorb returns nothing", "weight fails",
                                  "emit returns the state only", "jacobian fails", "h returns nothing"])  # fmt: skip
def test_checkers_name_the_line_too(name, tmp_path, monkeypatch):
    part, body, _ = MISTAKES[name]
    module = write(tmp_path, name, part, body)
    monkeypatch.syspath_prepend(str(tmp_path))
    cls = importlib.import_module(module).F
    settings = {"nodes": (0,), "R": [[0.5]]} if part == "SENSOR" else {}
    with pytest.raises(AssertionError, match=rf"{module}\.py, line [67]"):
        CHECKERS[part](cls(**settings))


def test_settings_without_a_name_and_unknown_ones():
    with pytest.raises(
        netkf.ScenarioError, match=r"^Poisson: takes no setting without a name; got 2"
    ):
        parts.Poisson(2.0)
    with pytest.raises(
        netkf.ScenarioError, match=r"^Gossip: takes no setting without a name; got 3"
    ):
        parts.Gossip(3)
    with pytest.raises(netkf.ScenarioError, match=r"^Poisson.rat: is no setting; got 2"):
        parts.Poisson(rat=2.0)
    assert parts.Bernoulli(0.5).delivery == 0.5


def test_a_dask_client_is_no_executor(ring):
    class Client:
        scheduler = SimpleNamespace(address="tcp://127.0.0.1:1234")

        def submit(self): ...
        def scatter(self): ...

    with pytest.raises(
        netkf.ScenarioError, match=r'Dask client; .*scheduler="tcp://127.0.0.1:1234"'
    ):
        netkf.monte_carlo(ring, runs=2, executor=Client())


def test_a_script_without_a_guard_is_run_once(tmp_path):
    script = f"""{HEAD}
import dataclasses, netkf
print("here")
@dataclass(frozen=True, eq=False)
class Own(Filter):
    def absorb(self, state, messages, exchange):
        return state
scenario = netkf.load("own.toml")
scenario = dataclasses.replace(
    scenario, filter=dataclasses.replace(scenario.filter, algorithm=Own()))
try:
    netkf.monte_carlo(scenario, runs=4, workers=2)
except netkf.EngineError as error:
    print(error)
"""
    table = SLOTS.replace("FILTER", 'kind = "local"')
    for one, value in PARTS.items():
        table = re.sub(rf"\b{one}\b", lambda _, value=value: value, table)
    (tmp_path / "own.toml").write_text(table)
    (tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    first, message = done.stdout.splitlines()
    assert first == "here"
    assert re.search(r'line 15 under if __name__ == "__main__":', message), message
    assert done.stderr == ""


HEALTHY = {
    "helpers that other methods call": (
        "Filter", "def weight(self, age): return 0.5\ndef updated(self, state): return state\n"
        "def absorb(self, state, messages, exchange):\n"
        "    return [self.weight(m.age) * self.updated(state) for m in messages]"),
    "helpers of a property, a nested function and a static method": (
        "Filter", "max_age: float = setting(positive, default=3.0)\nsteps = 2\n"
        "timing = property(lambda self: Timing(max_age=self.max_age, steps=lambda phase: self.steps))\n"
        f"@staticmethod\ndef redraw(): return True\n_first = property(lambda self: self.redraw())\n{SAME}"),
    "members that a value holds": (
        "Filter", "inverts = True\nneeds = Needs(inverts=inverts)\n"
        "def weight(degree, peer): return 0.1\nlink_weights = Weights(of=weight)\n" + SAME),
    "helpers whose names are their own": (
        "Filter", "gain = 0.3\ndef absorb_all(self, state): return state\n"
        "def innovation(self, y): return y\ndef evidence(self, state): return 1.0\n" + SAME),
    "settings with names of their own": (
        "Poisson", "bursts: int = setting(integer(1), default=2)\nspread: float = setting(positive, default=1.0)\n"
        "def mean_rate(self, entity): return self.bursts * self.spread"),
    "a method where the contract has a method, by assignment": (
        "Delay", "def one(self, random): return 1.0\ndraw = one"),
    "a property as a value, a value as a property": (
        "Loss", "independent = False\ndef delivery_probability(self, *arguments): return 1.0\n"
        "@property\ndef stateful(self): return self.independent"),
    "a helper of the module, and getattr": (
        "Filter", "max_age: float = setting(positive, default=3.0)\nsteps = 2\n"
        "timing = property(lambda self: timing_of(self))\n"
        f"_first = property(lambda self: getattr(self, 'steps'))\n{SAME}"),
    "the class, and a value inside another": (
        "Hybrid", "steps = 2\nredraws = True\n"
        "def absorb(self, state, messages, exchange): return type(self).steps\n"
        "_first = property(lambda self: self.__class__.redraws)"),
    "a setting instead of a property": (
        "Delay", "fixed: float = setting(positive, default=1.0)\ndef draw(self, random): return self.fixed"),
}  # fmt: skip


@pytest.mark.parametrize("name", HEALTHY)
def test_members_of_their_own_are_no_mistakes(name):
    base, body = HEALTHY[name]
    source = f"{HEAD}@dataclass(frozen=True, eq=False)\nclass F({base}):\n"
    source += (
        textwrap.indent(body, "    ") + "\ndef timing_of(part): return Timing(max_age=part.max_age)"
    )
    names = {"__name__": __name__}
    exec(source, names)
    settings = {"Hybrid": {"epsilon": 0.3}, "Poisson": {"rate": 1.0}}.get(base, {})
    assert names["F"](**settings)  # raises no ContractError


def test_members_that_derived_classes_and_mixed_in_ones_use_are_no_mistakes():
    class Mixed:
        def absorb(self, state, messages, exchange):
            return self.steps

    @dataclass(frozen=True, eq=False)
    class Base(Mixed, parts.Filter):
        steps = 2
        redraws = True

    class Derived(Base):
        @property
        def timing(self):
            return parts.Timing(redraws=lambda phase, step: self.redraws)

    assert Derived().timing.redraws(0, 0)
    with pytest.raises(
        TypeError, match=r"Base.redraws is never read: state it in timing, as Timing"
    ):
        Base()


def test_overrides_that_no_engine_calls_are_told_and_settings_may_decide():
    @dataclass(frozen=True, eq=False)
    class Timid(parts.ConstantDelay):
        def draw(self, random):
            return 2.0

    @dataclass(frozen=True, eq=False)
    class Talks(parts.Local):
        def absorb(self, state, messages, exchange):
            return state

    @dataclass(frozen=True, eq=False)
    class Sometimes(parts.Bernoulli):
        bursts: bool = parts.setting(parts.boolean, default=False)

        @property
        def stateful(self):
            return self.bursts

        def next_state(self, link, bad, random):
            return random.random() < 0.5

    with pytest.raises(TypeError, match=r"Timid.draw \(.*\) is never called where is_random is F"):
        Timid(1.0)
    with pytest.raises(TypeError, match=r"Talks.absorb \(.*\) is never called where timing.talks"):
        Talks()
    assert not Sometimes(0.5).stateful
