"""Check that a plant moves as its matrices say."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg

from netkf.core.errors import NetkfError
from netkf.linalg.arrays import FloatArray, is_semidefinite
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.plant import Plant
from netkf.rng.normals import GeneratorNormals
from netkf.rng.streams import Streams
from netkf.testing.noise import (
    Stated,
    check_uncorrelated,
    check_unrelated,
    check_white,
    whitening,
)
from netkf.testing.watching import (
    Watched,
    attempt,
    demand,
    demand_array,
    distance,
    make_part,
    user_code,
)

STARTS, STEPS, LENGTH = 40_000, 100_000, 400
FEW_STARTS = 10
GRID_RUNS, GRID_BLOCKS, MAX_RUNS = 100, 8, 2000
SHORT = 130
ROUNDING, FRAMED = 1e-9, 1e-6
GROWTH = math.log(1e6)
"""Logarithm of how much a state may grow in a run whose digits are looked at."""
GAPS = (0.7, 0.2, 1.0, 0.05)
"""Gaps between the times of a path, in units of the plant's own time."""


def check_plant(plant: Any, /, **settings: Any) -> None:
    """Check a plant, or a class with its ``settings``: x(0) of ``mean`` and ``cov``, and
    x[k+1] = F x[k] + w[k] with cov(w) = Q, or dx = A x dt + B dw.

    Exactly: shapes; equal streams give equal paths, whether states are asked for one by one or
    with some left out, in frames or not, alone or with other runs, at more probe times or fewer;
    a start that is moved moves the path by F^k or e^{A t} times as much (an error of F or A of any
    size is found); directions in which Q or ``cov`` have no noise have none; only the given
    generators are used; the plant survives pickle.

    By 40,000 starts, with probability 0.9: a mean of x(0) off by 0.04 standard deviations, a
    variance that is wrong by 6 %, a correlation of 0.04. By 100,000 steps (a diffusion 51,200 on
    its sensing grid, with the moments of x over each, and as many at sample and probe times): a
    mean of the noise of 0.03 standard deviations (diffusion 0.04), a variance wrong by 4 % (6 %), a
    correlation of 0.03 (0.04) between components, 1, 2, 3 or 7 steps apart, or with x(0) and
    between runs; in one quarter of a run errors must be twice as large, and
    for unstable plants, whose runs are short, up to three times. Recorded and unknown plants
    are not drawn: form and pickle only. A sound class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(plant, (Plant,), settings)
    check_made_plant(part, 0)


def check_made_plant(part: Any, seed: int) -> None:
    """Run ``check_plant`` on an object, with streams of the given seed."""
    watched = Watched(part)
    copy = watched.pickle_copy()
    name = watched.name
    _check_form(part, name)
    if not part.is_random:
        return
    before = watched.attributes()
    with user_code(name):
        if isinstance(part, LinearPlant):
            _check_slots(part, copy, name, seed)
        elif isinstance(part, Diffusion):
            _check_diffusion(part, copy, name, seed)
    watched.demand_unchanged(before)


def _check_form(part: Any, name: str) -> None:
    """Check the shapes of a plant's matrices and the covariance of x(0)."""
    n = part.n
    matrix = part.F if isinstance(part, LinearPlant) else getattr(part, "A", np.zeros((n, n)))
    square = isinstance(n, int) and matrix.shape == (n, n)
    demand(square, f"{name}.n", "must be the number of rows of the plant's matrix", n)
    noise = getattr(part, "Q", np.zeros((n, n)))
    demand(noise.shape == (n, n), f"{name}.Q", f"must have the shape {(n, n)}", str(noise.shape))
    demand_array(f"{name}.start_mean", "the mean of x(0)", part.start_mean, (n,))
    where = f"{name}.start_cov"
    cov = demand_array(where, "the covariance of x(0)", part.start_cov, (n, n))
    sound = np.allclose(cov, cov.T) and is_semidefinite(cov)
    demand(sound, where, "must be symmetric and positive semidefinite", cov)


def _with_other_start(part: Any) -> tuple[Any, FloatArray] | None:
    """Return the plant with another mean of x(0), and by how much it moved; None where its class
    fixes the mean.
    """
    wanted = part.start_mean + 3.0 * (1.0 + np.sqrt(np.diag(part.start_cov)))
    try:
        moved = dataclasses.replace(part, mean=wanted)
    except (NetkfError, TypeError, ValueError):
        return None
    offset = moved.start_mean - part.start_mean
    return (moved, offset) if offset.any() else None


def _make_random(seed: int, run: int, purpose: str = "plant") -> np.random.Generator:
    """Return the random generator of a run."""
    return Streams(seed, run).generator(purpose)


def _demand_same(where: str, one: FloatArray, other: FloatArray, when: str) -> None:
    """Check that two paths from equal streams are equal."""
    apart = distance(one, other)
    demand(
        apart <= ROUNDING,
        where,
        "must make the same path from equal streams",
        f"a difference of {apart:.3g} of its size {when}",
        "use only the generators given, and draw for each step in order",
    )


def _demand_follows(
    where: str, one: FloatArray, two: FloatArray, Phi: FloatArray, offset: FloatArray, law: str
) -> None:
    """Check that states (K, n) differ by ``Phi`` (K, n, n) times the offset of their starts."""
    expected = Phi @ offset
    gap = float(np.abs(two - one - expected).max() / (1.0 + np.abs(two).max()))
    worst = int(np.abs(two - one - expected).max(axis=1).argmax())
    demand(
        gap <= ROUNDING,
        where,
        f"a start that is moved must move the path by {law}, and the noise not at all",
        f"{two[worst] - one[worst]} instead of {expected[worst]}",
        "let the noise not depend on x, and use the matrix that the filters are told",
    )


def _check_starts(
    part: Any,
    where: str,
    seed: int,
    start: Callable[[np.random.Generator], FloatArray],
    inherited: bool,
) -> None:
    """Check the law of x(0), of which ``start`` draws one; ``inherited``: by netkf's own method."""
    white = whitening(part.start_cov)
    count = STARTS if len(white.free) else FEW_STARTS
    with user_code(where):
        found = _draw_starts(part, seed, start, inherited, count)
    demand_array(where, "x(0)", found[0], (part.n,))
    gaps = np.array(found) - part.start_mean
    size = 1.0 + float(np.abs(part.start_mean).max())
    off = float(np.abs(gaps @ white.certain.T).max(initial=0.0)) / size
    rule = "x(0) must be its mean in the directions in which cov has no variance"
    demand(off <= 1e-6, where, rule, f"{off:.3g} off", "start at mean + root of cov times normals")
    unit = gaps @ white.free.T
    if unit.size:
        check_white(unit[:, None], Stated(where, "x(0) less its mean", "cov"))


class _NormalsInTurn:
    """Standard normal numbers of ``count`` runs that take turns at one generator."""

    def __init__(self, random: np.random.Generator, count: int) -> None:
        self._random, self._count = random, count

    def draw(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the next numbers (count, *shape) of each run."""
        return self._random.standard_normal((self._count, *shape))


def _draw_starts(
    part: Any,
    seed: int,
    start: Callable[[np.random.Generator], FloatArray],
    inherited: bool,
    count: int,
) -> Sequence[FloatArray]:
    """Draw x(0) ``count`` times, all at once where ``start`` is ``inherited`` and gives the same
    as ``starts``.
    """
    random = _make_random(seed, 0)
    found = [start(random) for _ in range(min(count, FEW_STARTS))]
    if inherited and type(part).starts is Plant.starts:
        # One by one, they take most of the time of a check.
        drawn = part.starts(_NormalsInTurn(_make_random(seed, 0), count))
        first = drawn[: len(found)]
        if np.shape(found) == first.shape and distance(np.array(found), first) <= ROUNDING:
            return [*found, *drawn[len(found) :]]
    return [*found, *(start(random) for _ in range(count - len(found)))]


def _check_noise(
    noise: FloatArray, S: FloatArray, states: FloatArray, stated: Stated, rule: str
) -> None:
    """Check noise (R, K, n) of covariance ``S`` that is added to ``states`` (R, K, n)."""
    white = whitening(S)
    size = 1.0 + float(np.abs(states).max())
    off = float(np.abs(noise @ white.certain.T).max(initial=0.0)) / size
    demand(off <= FRAMED, stated.where, rule, f"{off:.3g} of the state left over without noise")
    e = noise @ white.free.T
    if not e.size:
        return
    check_white(e, stated)
    flat = states.reshape(-1, states.shape[-1])
    check_unrelated(e.reshape(len(flat), -1), flat, stated, "the state before")
    first = whitening(np.atleast_2d(np.cov(states[:, 0].T))).free
    if first.size and len(e) > 1:
        start = (states[:, 0] - states[:, 0].mean(axis=0)) @ first.T
        check_uncorrelated(start, e[:, 0], stated._replace(noise="x(0) and the noise"), "after it")


def _check_slots(part: LinearPlant, copy: LinearPlant, name: str, seed: int) -> None:
    """Check a plant in slots: repeatable paths, moving frames, and the law of the noise."""
    where = f"{name}.truth"

    def path(plant: Any, slots: Sequence[int], run: int = 0) -> FloatArray:
        """Return the states (slots, n) of a run."""
        with user_code(where):
            truth = plant.truth(_make_random(seed, run))
            found = [truth.state(slot) for slot in slots]
        demand_array(where, "a state", found[0], (part.n,))
        return np.array([np.asarray(x).reshape(-1) for x in found])

    radius = float(np.abs(np.linalg.eigvals(part.F)).max())
    length = LENGTH if radius <= 1.0 else max(8, min(LENGTH, int(GROWTH / math.log(radius))))
    short = min(SHORT, length)
    numbers = list(range(short + 1))
    whole = path(part, numbers)
    _demand_same(where, whole, path(part, numbers), "at the second call")
    _demand_same(where, whole, path(copy, numbers), "of a pickled plant")
    some = [0, 0, 3, short // 2, short // 2, short]
    _demand_same(where, whole[some], path(part, some), "when slots are left out or asked for twice")
    _check_frames(part, where, whole, seed)
    other = _with_other_start(part)
    if other is not None:
        Phi = np.array([np.linalg.matrix_power(part.F, k) for k in numbers])
        _demand_follows(where, whole, path(other[0], numbers), Phi, other[1], "powers of F")
    inherited = type(part).truth is LinearPlant.truth
    _check_starts(part, where, seed, lambda random: part.truth(random).state(0), inherited)
    runs = max(2, min(MAX_RUNS, STEPS // length))
    states = np.array([path(part, range(length + 1), run) for run in range(runs)])
    steps = states[:, 1:] - states[:, :-1] @ part.F.T
    stated = Stated(where, "the noise x[k+1] - F x[k]", "Q")
    _check_noise(
        steps, part.Q, states[:, :-1], stated, "x[k+1] must be F x[k] where Q has no noise"
    )


def _check_frames(part: LinearPlant, where: str, whole: FloatArray, seed: int) -> None:
    """Check that states in frames are those without, less the origin of the frame."""
    with user_code(where):
        _compare_frames(part, where, whole, part.truth(_make_random(seed, 0), True))


def _compare_frames(part: LinearPlant, where: str, whole: FloatArray, truth: Any) -> None:
    """Check the absolute and local states of a truth with moving frames."""
    frame = truth.frame_slots
    origin = np.zeros(part.n)
    for slot, x in enumerate(whole):
        origin = part.F @ origin if slot else origin
        for text, state in (
            ("absolute", truth.absolute(slot)),
            ("local", truth.local(slot) + origin),
        ):
            apart = distance(np.asarray(state), x)
            rule = f"{text} states must be the same in frames, up to the origin"
            demand(apart <= FRAMED, where, rule, f"{apart:.3g} of the state apart in slot {slot}")
        if frame and slot and slot % frame == 0:
            origin = origin + truth.rebase(slot)
            zero = not np.any(truth.local(slot))
            demand(zero, where, "the local state must be 0 where a frame begins", truth.local(slot))


def transition_law(A: FloatArray, B: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """Return ``e^{A g}`` and the covariance of the noise over ``gap`` seconds, Van Loan 1978."""
    n = len(A)
    block = np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]) * gap
    E = scipy.linalg.expm(block)
    Phi = E[n:, n:].T
    return Phi, Phi @ E[:n, n:]


def moment_law(A: FloatArray, B: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """Return the response (3 n, n) to the state, and the covariance (3 n, 3 n) of the noise, of the
    state after ``gap`` seconds with the two moments of x over them.
    """
    n, zero, one = len(A), np.zeros_like(A), np.eye(len(A))
    # x, I = int x ds and J = int I ds: int s x ds = g I - J.
    chain = np.block([[A, zero, zero], [one, zero, zero], [zero, one, zero]])
    Phi, S = transition_law(chain, np.concatenate([B, np.zeros((2 * n, B.shape[1]))]), gap)
    # int (2 s / g - 1) x ds = I - 2 J / g.
    T = np.block([[one, zero, zero], [zero, one, zero], [zero, one, -2.0 / gap * one]])
    return (T @ Phi)[:, :n], T @ S @ T.T


def _check_diffusion(part: Diffusion, copy: Diffusion, name: str, seed: int) -> None:
    """Check a plant in continuous time: first states, sampled truth and grid."""
    speed = float(np.abs(np.linalg.eigvals(part.A)).max())
    growth = float(np.linalg.eigvals(part.A).real.max())
    second = 1.0 / speed if speed > 0.0 else 1.0
    longest = GROWTH / growth if growth > 0.0 else math.inf
    inherited = type(part).start is Diffusion.start
    _check_starts(part, f"{name}.start", seed, part.start, inherited)
    _check_sampled(part, copy, f"{name}.sampled_truth", seed, (second, longest))
    period = part.sensing_period or min(0.1 * second, part.longest_period)
    grid = dataclasses.replace(part, sensing_period=period)
    _check_grid(grid, name, seed, max(2, int(min(longest / period, 64.0))))


def _check_sampled(
    part: Diffusion, copy: Diffusion, where: str, seed: int, scale: tuple[float, float]
) -> None:
    """Check paths at sample and probe times; ``scale`` is the plant's own time, and how long a
    run may be without losing digits, in seconds.
    """
    second, longest = scale
    gaps = second * np.tile(GAPS, LENGTH // len(GAPS))
    times = np.cumsum(gaps)
    times = times[times <= max(longest, times[7])]
    samples, probes = np.delete(times, np.s_[::3]), times[::3]
    horizon = float(times[-1]) * 1.01

    def path(
        plant: Any, at: FloatArray, run: int = 0, sample_times: FloatArray = probes
    ) -> FloatArray:
        """Return the states (times, n) of a run."""
        randoms = [_make_random(seed, run, purpose) for purpose in ("plant", "probe")]
        truth = attempt(where, plant.sampled_truth, *randoms, samples, sample_times, horizon)
        asked = np.concatenate([[0.0], at])
        found = np.asarray(attempt(where, truth.states, asked)[1])
        return demand_array(where, "states", found, (len(asked), part.n))

    whole = path(part, times)
    _demand_same(where, whole, path(part, times), "at the second call")
    _demand_same(where, whole, path(copy, times), "of a pickled plant")
    drawn = np.isin(np.concatenate([[0.0], times]), probes, invert=True)
    fewer = path(part, samples, sample_times=probes[:0])
    _demand_same(where, whole[drawn], fewer, "when nothing is probed")
    laws = [transition_law(part.A, part.B, second * gap) for gap in GAPS]
    other = _with_other_start(part)
    if other is not None:
        since = [np.eye(part.n)]
        for k in range(len(times)):
            since.append(laws[k % len(GAPS)][0] @ since[-1])
        moved = path(other[0], times)
        _demand_follows(where, whole, moved, np.array(since), other[1], "e^{A t}")
    runs = max(2, min(MAX_RUNS, STEPS // (2 * len(times))))
    states = np.array([path(part, times, run) for run in range(runs)])
    for k, (Phi, S) in enumerate(laws):
        steps = (
            states[:, k + 1 :: 4] - states[:, k:-1:4][:, : states[:, k + 1 :: 4].shape[1]] @ Phi.T
        )
        before = states[:, k:-1:4][:, : steps.shape[1]]
        text = f"the noise x(t + g) - e^(A g) x(t) over {second * GAPS[k]:.3g} s"
        rule = "x(t + g) must be e^(A g) x(t) where B has no noise"
        _check_noise(steps, S, before, Stated(where, text, "B"), rule)


def _check_grid(part: Diffusion, name: str, seed: int, steps: int) -> None:
    """Check paths on the sensing grid, which are drawn together or alone, cut or not."""
    where, period = f"{name}.paths", float(part.sensing_period or 0.0)
    count = -(-steps // 64)
    sample_times = period * np.array([1.3, 4.0, 5.5, 5.7])
    sampled = period * np.array([2.5, 5.6])

    def drawn(runs: Sequence[int], cuts: bool = False, blocks: int = count) -> Any:
        """Return the first paths of some runs on the grid."""
        own, shows, samples = (
            GeneratorNormals([_make_random(seed, run, purpose) for run in runs])
            for purpose in ("plant", "probe", "samples")
        )
        none = np.empty(0)
        at = (sample_times, samples, sampled) if cuts else (none, samples, none)
        return attempt(where, part.paths, own, shows, *at).following(blocks)

    whole = drawn(range(3))
    alone = drawn([1])
    _demand_same(where, whole.x_end[1], alone.x_end[0], "of a run by itself")
    cut = drawn([1], cuts=True)
    last = np.append(np.diff(cut.step) > 0, True)
    _demand_same(where, alone.x_end[0], cut.x_end[0][last], "at the points of its grid when cut")
    _check_one_path(part, f"{name}.path", cut, (sample_times, sampled), seed)
    other = _with_other_start(part)
    if other is not None:
        moved = other[0].paths(
            *(GeneratorNormals([_make_random(seed, 1, p)]) for p in ("plant", "probe")),
            sample_times[:0],
        )
        Phi = np.array([scipy.linalg.expm(part.A * period * k) for k in range(1, steps + 1)])
        two = moved.following(count).x_end[0][:steps]
        _demand_follows(where, alone.x_end[0][:steps], two, Phi, other[1], "e^{A t}")
    runs = max(2, GRID_RUNS * GRID_BLOCKS * 64 // (64 * count))
    found = drawn(range(runs))
    start, end = found.x_start[:, :steps], found.x_end[:, :steps]
    ends = np.concatenate([end, *(found.moments[:, :steps, m] for m in range(2))], axis=2)
    Phi, S = moment_law(part.A, part.B, period)
    text = f"the noise of x and its two moments over steps of {period:g} s"
    rule = "x and its moments must follow from the state before where B has no noise"
    # In units in which x and its moments are of one size.
    units = np.repeat([1.0, 1.0 / period, 1.0 / period], part.n)
    noise = (ends - start @ Phi.T) * units
    _check_noise(noise, S * np.outer(units, units), start, Stated(where, text, "B"), rule)


def _check_one_path(
    part: Diffusion, where: str, cut: Any, at: tuple[FloatArray, FloatArray], seed: int
) -> None:
    """Check that the path of one run is the one that is drawn with others."""
    randoms = [_make_random(seed, 1, purpose) for purpose in ("plant", "probe", "samples")]
    own, shows, samples = randoms
    path = attempt(where, part.path, own, shows, at[0], samples, at[1])
    times = np.unique(np.concatenate([cut.end[:20], *at]))
    with user_code(where):
        x = np.array([path.local(time) for time in times.tolist()])
    indices = np.searchsorted(cut.end, times)
    _demand_same(
        where, cut.x_end[0][indices], x, "from the one that `paths` draws for the same run"
    )
