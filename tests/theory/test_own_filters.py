"""A user's filter in kernels has exact errors under clocks, without an equation of its own."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf import theory
from netkf.kernels import Kernels, Record
from netkf.parts import Analysis, Filter
from netkf.scenario.reading import from_table
from netkf.theory.errors import error_law
from netkf.trace.schema import CODES

# Constant gains, and a memory of the newest estimate heard over each link, used again and again.
REMEMBERING = """
from netkf.kernels import (
    Kernels, Record, carry_mean, copy_vector, kernel, predict_estimate, shift_vector
)
from netkf.parts import Filter, Needs, Timing


@kernel
def predict(record, h, run):
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    for w in range(run.first[h], run.first[h + 1]):
        carry_mean(run.model, run, record.heard, w, run.gap)


@kernel
def update(record, h, run):
    for row in range(run.rows[run.reading]):
        innovation = run.y[run.first_y + run.reading, row, 0]
        for j in range(len(run.size)):
            H = run.H[run.first_H + run.matrix[run.reading], row, j, 0]
            innovation -= H * record.xhat[h, j, 0]
        for j in range(len(run.size)):
            record.xhat[h, j, 0] += record.gain * (j + 1) * innovation


@kernel
def emit(record, h, m, run):
    copy_vector(run.lanes, run.size, record.payload.x, m, record.xhat, h, True)


@kernel
def absorb(record, h, run):
    for k in range(run.count):
        m, w = run.message[k], run.link[k]
        carry_mean(run.model, run, record.payload.x, m, run.age[k])
        copy_vector(run.lanes, run.size, record.heard, w, record.payload.x, m, True)
        record.told[w, 0] = 1.0
    for w in range(run.first[h], run.first[h + 1]):
        for j in range(len(run.size)):
            difference = record.heard[w, j, 0] - record.xhat[h, j, 0]
            record.xhat[h, j, 0] += record.gain * record.told[w, 0] * difference


@kernel
def shift(record, h, run):
    shift_vector(run, record.xhat, h)
    for w in range(run.first[h], run.first[h + 1]):
        shift_vector(run, record.heard, w)


@kernel
def shift_payload(record, m, run):
    shift_vector(run, record.payload.x, m)


def remembering_record(filtering, infos, models):
    n = len(models[0].information)
    return Record(
        link={"heard": (n,), "told": ()}, payload={"x": (n,)}, settings={"gain": 0.15}
    )


class Remembering(Filter):
    timing = Timing(schedule=None, clocks=("nodes", "directions", "readings"))
    needs = Needs(samples=True)
    kernels = Kernels(
        record=remembering_record, predict=predict, update=update, emit=emit, absorb=absorb,
        shift=shift, shift_payload=shift_payload,
    )
    shift = Filter.shift
"""
A, B = np.array([[0.1, 0.5], [-0.6, 0.2]]), np.array([[0.8, 0.0], [0.1, 0.5]])
H, R, GAIN, N = np.array([[1.0, 0.3]]), 0.4, 0.15, 4
STARTS = np.array([[0.7, -0.4], [1.5, 0.2], [-2.0, 3.0], [0.0, 0.1]])


def scenario_in(folder, at):
    (folder / "remembering.py").write_text(REMEMBERING)
    channel = {
        "loss": {"kind": "bernoulli", "delivery": 0.7},
        "delay": {"kind": "uniform", "low": 0.0, "high": 0.9},
        "symmetric": False,
    }
    sampling = {"kind": "periodic", "period": 0.5, "jitter": 0.2}
    activation = {"kind": "poisson", "rate": 2.0, "at": at}
    table = {
        "format": 1,
        "name": "own",
        "horizon": 30.0,
        "probe": [2.0, 11.0, 29.5],
        "plant": {"kind": "diffusion", "A": A.tolist(), "B": B.tolist(), "cov": np.eye(2).tolist()},
        "sensors": [{"nodes": [0, 2], "H": H.tolist(), "R": [[R]], "sampling": sampling}],
        "network": {
            "graph": {"kind": "cycle", "nodes": N},
            "activation": {"kind": "readings"} if at == "readings" else activation,
            "channel": channel,
        },
        "filter": {"kind": "remembering:Remembering", "mean": STARTS.tolist()},
        "seed": 3,
    }
    return from_table(table, folder, trust=True)


class Plain:
    """All vectors as affine functions of the noises so far: column 0 is the constant."""

    def __init__(self):
        self.now, self.vectors = 0.0, {"x": np.eye(2, 3, 1)}
        for i, mean in enumerate(STARTS):
            self.vectors[i] = np.column_stack([mean, np.zeros((2, 2))])

    def add(self, noise):
        """Add ``noise`` (2, k) times new noises to x, and nothing to all else."""
        for name, vector in self.vectors.items():
            new = noise if name == "x" else np.zeros_like(noise)
            self.vectors[name] = np.column_stack([vector, new])

    def advance(self, time):
        gap, self.now = time - self.now, time
        if gap > 0.0:
            big = np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]])
            both = scipy.linalg.expm(big * gap)
            F = both[2:, 2:].T
            self.vectors = {name: F @ vector for name, vector in self.vectors.items()}
            self.add(np.linalg.cholesky(F @ both[:2, 2:]))

    def sample(self, i):
        self.add(np.zeros((2, 1)))
        y = H @ self.vectors["x"] / np.sqrt(R)
        y[0, -1] = 1.0
        innovation = y - H @ self.vectors[i] / np.sqrt(R)
        self.vectors[i] = self.vectors[i] + GAIN * np.array([[1.0], [2.0]]) * innovation

    def absorb(self, i, inbox):
        for sender, message in sorted(inbox):
            self.vectors["heard", i, sender] = self.vectors.pop(message)
        for j in range(N):
            if ("heard", i, j) in self.vectors:
                difference = self.vectors["heard", i, j] - self.vectors[i]
                self.vectors[i] = self.vectors[i] + GAIN * difference

    def errors(self):
        return np.concatenate([self.vectors["x"] - self.vectors[i] for i in range(N)])


def by_hand(run):
    """Mean and joint covariance of the errors of all nodes at all times, from the log alone."""
    plain, inboxes, kept = Plain(), {}, []
    rows = run.log[["t", "kind", "node", "peer", "message"]].tolist()
    arrive = {(peer, node, k) for _, kind, node, peer, k in rows if kind == CODES["deliver"]}
    samples = [(t, 99, -1, -1, -1) for t in run.times.tolist()]
    for t, kind, node, peer, number in sorted([*rows, *samples], key=lambda row: row[0]):
        plain.advance(t)
        if kind == 99:
            kept.append(plain.errors())
        elif kind == CODES["sense"]:
            plain.sample(node)
        elif kind == CODES["send"] and (node, peer, number) in arrive:
            plain.vectors["message", node, peer, number] = plain.vectors[node]
        elif kind == CODES["deliver"]:
            # Of several messages of a sender the newest counts.
            inboxes.setdefault(node, {})[peer] = "message", peer, node, number
        elif kind == CODES["absorb"]:
            plain.absorb(node, inboxes.pop(node).items())
    width = kept[-1].shape[1]
    forms = np.concatenate([np.pad(e, ((0, 0), (0, width - e.shape[1]))) for e in kept])
    return forms[:, 0], forms[:, 1:] @ forms[:, 1:].T


def test_a_filter_in_kernels_has_exact_errors(tmp_path):
    for at in ("nodes", "directions", "readings"):
        scenario = scenario_in(tmp_path, at)
        run = netkf.simulate(scenario, engine="simpy")
        assert run.count("lost") > 20
        assert (run.log["age"][run.log["kind"] == CODES["absorb"]] > 0.1).any()
        mean, covariance = by_hand(run)
        law = error_law(scenario, run)
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(law.mean / scale, mean / scale, rtol=0, atol=1e-10)
        gap = np.abs(law.covariance - covariance) / np.outer(scale, scale)
        assert gap.max() < 1e-10
        stacked = theory.error_covariance(scenario, run, stacked=True)
        joint = covariance.reshape(3, 2 * N, 3, 2 * N)
        np.testing.assert_allclose(stacked, np.einsum("kakb->kab", joint), rtol=1e-9, atol=1e-9)


@dataclass(frozen=True, eq=False)
class Sharing(Filter):
    """Averages estimates, in plain Python."""

    analysis = Analysis(affine=True)

    def absorb(self, state, messages, exchange):
        mean = state.xhat
        for message in messages:
            mean = mean + message.weight * (message.payload.xhat - state.xhat)
        return state._replace(xhat=mean)

    def shift(self, state, offset):
        return state._replace(xhat=state.xhat + offset)


@dataclass(frozen=True, eq=False)
class Flagging(Filter):
    kernels = Kernels(
        lambda *_: Record(node={"flag": ((), np.uint8)}, payload={"xhat": (2,), "root": (2, 2)})
    )
    shift = Filter.shift


def test_what_is_not_known_of_own_verbs_is_said(ring):
    """Verbs in Python were not given the increments, and errors were four times too large."""
    for filtering, words in (
        (Sharing(), "known for sampled sensors"),
        (Flagging(), "need records of int64 and float64, and flag is uint8"),
    ):
        scenario = ring.replace({"horizon": 1.0, "filter": filtering})
        with pytest.raises(netkf.TheoryError, match=words):
            theory.error_covariance(scenario, netkf.simulate(scenario, engine="simpy"))
