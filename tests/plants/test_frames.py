"""States in frames keep the digits that growth takes from absolute ones."""

import mpmath
import numpy as np
import pytest

from netkf.plants import linear
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.transitions import Transitions, frame_period, frame_slots
from netkf.rng.normals import GeneratorNormals
from netkf.rng.streams import Streams

SPIRAL = np.array([[0.3, 1.0], [-1.0, 0.3]])
COV = np.array([[2.0, 0.5], [0.5, 1.0]])


def generators(count):
    return [np.random.default_rng(k) for k in range(count)]


def test_periods_allow_a_growth_of_two_to_the_tenth():
    assert frame_period(np.array([[0.5, 7.0], [0.0, -3.0]])) == 10.0  # 13.9 s, rounded down
    assert frame_slots(np.array([[np.sqrt(2.0)]])) in (19, 20)
    assert frame_slots(np.array([[5000.0]])) == 1
    for stable in (-np.eye(2), np.array([[0.0, 1.0], [0.0, 0.0]])):
        assert frame_period(stable) is None
    assert frame_slots(np.eye(2)) is None


@pytest.mark.one_in(4)
@pytest.mark.parametrize("block", [1, 7, 64])
@pytest.mark.parametrize("growth", [1.05, np.sqrt(2.0), 3000.0])
def test_local_increments_in_slots_are_exact(growth, block, monkeypatch):
    plant = LinearPlant(F=[[growth]], Q=[[1.0]], period=1.0, cov=[[4.0]])
    reference = plant.truth(np.random.default_rng(1))
    noise = np.random.default_rng(1).standard_normal(1 + 10_000)
    monkeypatch.setattr(linear, "BLOCK", block)
    path = plant.truth(np.random.default_rng(1), frames=True)
    assert path.frame_slots == frame_slots(plant.F)
    before = path.local(0)
    assert before == reference.local(0)
    for slot in range(1, 10_000):
        x = path.local(slot)
        assert abs(x[0] - growth * before[0] - noise[slot]) <= 1e-12 * max(1.0, abs(x[0]))
        if slot < 80:
            np.testing.assert_allclose(path.absolute(slot), reference.state(slot), rtol=1e-12)
        if slot % path.frame_slots == 0:
            np.testing.assert_array_equal(path.rebase(slot), x)
            assert path.local(slot) == 0.0
            if slot < 80:
                np.testing.assert_allclose(path.absolute(slot), reference.state(slot), rtol=1e-12)
            x = np.zeros(1)
        before = x


def test_slots_without_growth_have_no_frames():
    plant = LinearPlant(F=[[0.9]], Q=[[1.0]], period=1.0)
    assert plant.truth(np.random.default_rng(1), frames=True).frame_slots is None


def walked(path, times):
    """Local and absolute states at times, with all rebases in between."""
    found, k = [], 0
    for t in times:
        while k < len(path.frame_times) and path.frame_times[k] <= t:
            path.rebase(k)
            k += 1
        found.append((path.local(t), path.absolute(t)))
    local, absolute = zip(*found, strict=True)
    return np.array(local), np.array(absolute)


@pytest.mark.parametrize("kind", ["grid", "sampled"])
def test_local_states_and_origins_make_the_absolute_ones(kind):
    plant = Diffusion(SPIRAL, np.eye(2), mean=[1.0, 0.0], cov=COV, sensing_period=0.1)
    probes = np.round(np.arange(0.0, 100.0, 0.7), 12)

    def make(frames):
        if kind == "grid":
            return plant.path(*generators(2), probes, horizon=100.0, frames=frames)
        samples = np.round(np.arange(0.3, 100.0, 0.9), 12)
        random, times = Streams(1).generator("plant"), np.concatenate([samples, probes, [100.0]])
        return plant.sampled_truth(random, times, 100.0, frames)

    framed, plain = make(True), make(False)
    assert len(framed.frame_times) == 4
    assert len(plain.frame_times) == 0
    local, absolute = walked(framed, probes)
    same, whole = walked(plain, probes)
    np.testing.assert_array_equal(same, whole)
    sizes = np.abs(whole).max(axis=1, keepdims=True)
    assert (np.abs(absolute - whole) <= 1e-11 * sizes).all()
    assert np.abs(local).max() < 1e5 < np.abs(whole).max()
    # The first frame's offset is the absolute state, and moves as the plant does.
    begin = framed.frame_times[0]
    first = int(np.searchsorted(probes, begin))
    move = Transitions(plant.A, plant.B).transitions(probes[first : first + 1] - begin)[0]
    shift = move @ make(True).rebase(0)
    np.testing.assert_allclose(local[first] + shift, whole[first], rtol=1e-11)


def test_blocks_do_not_show_in_frames():
    plant = Diffusion(SPIRAL, np.eye(2), mean=[1.0, 0.0], cov=COV, sensing_period=0.2)
    made = plant.paths(
        *[GeneratorNormals([g]) for g in generators(2)], np.array([3.33]), frames=True
    )
    again = plant.paths(
        *[GeneratorNormals([g]) for g in generators(2)], np.array([3.33]), frames=True
    )
    one = made.following(4)
    parts = [again.following(k) for k in (1, 2, 1)]
    for name in ("x_start", "x_end", "moments"):
        joined = np.concatenate([getattr(part, name) for part in parts], axis=1)
        np.testing.assert_array_equal(getattr(one, name), joined)
    assert (made.frame_steps, len(one.x_start[0]) - 256) == (100, 1)


def test_errors_in_frames_against_mpmath():
    """A filter in frames over growth e^200, against the same equations with 120 digits."""
    a, period, count = 0.5, 0.25, 1600
    plant = Diffusion([[a]], [[1.0]], mean=[0.0], cov=[[4.0]])
    samples = period * np.arange(1, count + 1)
    path = plant.sampled_truth(Streams(3).generator("plant"), samples, 401.0, frames=True)
    noise = np.random.default_rng(5).standard_normal(count)
    F = float(np.exp(a * period))
    gain = 1.0 - 1.0 / (F * F)  # near that of the steady filter
    assert path.frame_times[-1] > 380.0
    # In frames: predict, shift, update.
    local, xhat, now, k = [], 0.0, 0.0, 0
    for t, v in zip(samples.tolist(), noise.tolist(), strict=True):
        while k < len(path.frame_times) and path.frame_times[k] <= t:
            gap = path.frame_times[k] - now
            xhat, now = np.exp(a * gap) * xhat - path.rebase(k)[0], path.frame_times[k]
            k += 1
        xhat, now = np.exp(a * (t - now)) * xhat, t
        x = path.local(t)[0]
        xhat += gain * (x + v - xhat)
        local.append(x - xhat)
    # With many digits: the same noise, what local states add to those before.
    with mpmath.workdps(120):
        x = mpmath.mpf(path.absolute(0.0)[0])
        errors, xhat, before, first = [], mpmath.mpf(0), 0.0, mpmath.mpf(path.absolute(0.0)[0])
        readings = dict(zip(samples.tolist(), noise.tolist(), strict=True))
        frames = dict(zip(path.frame_times.tolist(), path.offsets[:, 0].tolist(), strict=True))
        for t in np.unique(np.concatenate([samples, path.frame_times])).tolist():
            grown = mpmath.exp(a * (mpmath.mpf(t) - mpmath.mpf(before)))
            last = mpmath.mpf(frames.get(t, path.local(t)[0]))
            x, xhat, before = grown * x + last - grown * first, grown * xhat, t
            first = mpmath.mpf(path.local(t)[0])
            if t in readings:
                xhat += mpmath.mpf(gain) * (x + mpmath.mpf(readings[t]) - xhat)
                errors.append(float(x - xhat))
    assert abs(float(mpmath.log(abs(x)))) > 190.0
    np.testing.assert_allclose(local, errors, rtol=0, atol=1e-11)


def test_frames_on_the_grid_rebase_the_moments():
    """Moments of pieces after a rebase are those of the local state."""
    plant = Diffusion([[0.5]], [[0.0]], mean=[1.0], cov=[[0.0]], sensing_period=0.1)
    path = plant.path(*generators(2), np.empty(0), horizon=40.0, frames=True)
    assert plant.frame_steps == 100
    start = path.grid(99)
    whole = (np.exp(5.0) - np.exp(4.95)) / 0.5  # the integral of e^{0.5 t}
    np.testing.assert_allclose(path.moments(start, path.grid(100))[0], whole, rtol=1e-9)
    np.testing.assert_allclose(path.rebase(0), np.exp(5.0), rtol=1e-10)
    assert not path.moments(path.grid(100), path.grid(101)).any()
    assert not path.local(path.grid(150)).any()
    np.testing.assert_allclose(path.absolute(path.grid(150)), np.exp(7.5), rtol=1e-10)
