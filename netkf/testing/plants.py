"""``check_plant``: checks of the states of a plant against its matrices."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg

from netkf.core.errors import NetkfError
from netkf.laws.noise import moment_law, transition_law, whiten
from netkf.linalg.arrays import FloatArray, is_semidefinite
from netkf.linalg.spectra import eigenvalues, growth_factor, growth_rate
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.paths import BLOCK
from netkf.plants.plant import Plant
from netkf.rng.normals import GeneratorNormals
from netkf.rng.streams import Streams
from netkf.testing.noise import (
    NoiseLabels,
    check_independent,
    check_uncorrelated,
    check_white,
    whitened,
)
from netkf.testing.watching import (
    ROUNDING,
    WatchedPart,
    call_user_function,
    demand,
    demand_array,
    demand_close,
    guard_user_code,
    make_part,
    scaled_difference,
)

STARTS, STEPS, LENGTH = 40_000, 100_000, 400
"""Draws of x(0), steps of the state in all runs together, and steps of a run, for statistics."""
FEW_STARTS = 10
"""Draws of x(0) where it is not random."""
GRID_STEPS, MAX_RUNS = 51_200, 2000
"""Steps on the sensing grid in all runs together, and largest number of runs off that grid."""
SHORT_LENGTH = 130
"""Slots in which paths are compared exactly."""
FRAME_TOLERANCE = 1e-6
"""Relative difference of equal paths in frames."""
MAX_LOG_GROWTH = math.log(1e6)
"""Logarithm of the largest growth of the state of an unstable plant in a run."""
GAPS = (0.7, 0.2, 1.0, 0.05)
"""Gaps between the times of a path, in units of the time constant of the plant."""


def check_plant(plant: Any, /, **settings: Any) -> None:
    """Check a plant, or a class with its ``settings``.

    Its law is x(0) of mean ``mean`` and covariance ``cov``, and x[k+1] = F x[k] + w[k] with
    cov(w) = Q, or dx = A x dt + B dw.

    Exact checks: shapes; equal streams give equal paths, whether states are read one by one or some
    are left out, in frames or not, alone or with other runs, and at more times or fewer; a start
    that is moved moves the path by F^k or e^{A t} times as much, which finds an error of F or A of
    any size; there is no noise in directions in which Q or ``cov`` have none; only the given
    generators are used; the plant survives pickle.

    Statistical checks find these errors with probability 0.9. From 40,000 starts: a mean of x(0)
    off by 0.04 standard deviations, a variance off by 6 %, a correlation of 0.04. From 100,000
    steps (of a diffusion 51,200 on its sensing grid, with the moments of x over each, and as many
    between sample and probe times): a mean of the noise of 0.03 standard deviations (diffusion
    0.04), a variance off by 4 % (6 %), and a correlation of 0.03 (0.04) between components, between
    steps 1, 2, 3 or 7 apart, with x(0), or between runs. Errors in only one quarter of a run must
    be twice as large; for unstable plants, whose runs are short, up to three times. Recorded and
    unknown plants are checked for form and pickle only. A correct class fails once in a million
    checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(plant, (Plant,), settings)
    _check_plant(part, 0)


def _check_plant(part: Any, seed: int) -> None:
    watched = WatchedPart(part)
    copy = watched.pickle_copy()
    name = watched.name
    _check_form(part, name)
    if not part.is_random:
        return
    before = watched.attributes()
    with guard_user_code(name):
        if isinstance(part, LinearPlant):
            _check_slots(part, copy, name, seed)
        elif isinstance(part, Diffusion):
            _check_diffusion(part, copy, name, seed)
    watched.demand_unchanged(before)


def _check_form(part: Any, name: str) -> None:
    n = part.n
    matrix = part.F if isinstance(part, LinearPlant) else getattr(part, "A", np.zeros((n, n)))
    fits = isinstance(n, int) and matrix.shape == (n, n)
    demand(fits, f"{name}.n", "must be the number of rows of the plant's matrix", n)
    noise = getattr(part, "Q", np.zeros((n, n)))
    demand(noise.shape == (n, n), f"{name}.Q", f"must have the shape {(n, n)}", str(noise.shape))
    demand_array(f"{name}.start_mean", "the mean of x(0)", part.start_mean, (n,))
    where = f"{name}.start_cov"
    cov = demand_array(where, "the covariance of x(0)", part.start_cov, (n, n))
    is_covariance = np.allclose(cov, cov.T) and is_semidefinite(cov)
    demand(is_covariance, where, "must be symmetric and positive semidefinite", cov)


def _move_start(part: Any) -> tuple[Any, FloatArray] | None:
    """Return the plant with another mean of x(0), and the difference (n,); or None."""
    mean = part.start_mean + 3.0 * (1.0 + np.sqrt(np.diag(part.start_cov)))
    try:
        moved = dataclasses.replace(part, mean=mean)
    except (NetkfError, TypeError, ValueError):
        return None
    offset = moved.start_mean - part.start_mean
    return (moved, offset) if offset.any() else None


def _make_generator(seed: int, run: int, purpose: str = "plant") -> np.random.Generator:
    return Streams(seed, run).generator(purpose)


def _demand_same(where: str, one: FloatArray, other: FloatArray, when: str) -> None:
    remedy = "use only the generators given, and draw for each step in order"
    demand_close(one, other, where, "must make the same path from equal streams", when, remedy)


def _demand_moved(
    where: str, x: FloatArray, moved: FloatArray, Phi: FloatArray, offset: FloatArray, law: str
) -> None:
    """Check that ``moved`` (K, n) is ``x`` plus ``Phi`` (K, n, n) times ``offset`` (n,)."""
    expected = Phi @ offset
    error = np.abs(moved - x - expected)
    worst = int(error.max(axis=1).argmax())
    rule = f"a start that is moved must move the path by {law}, and the noise not at all"
    got = f"{moved[worst] - x[worst]} instead of {expected[worst]}"
    remedy = "let the noise not depend on x, and use the matrix that the filters are told"
    demand(float(error.max() / (1.0 + np.abs(moved).max())) <= ROUNDING, where, rule, got, remedy)


def _check_starts(
    part: Any,
    where: str,
    seed: int,
    start: Callable[[np.random.Generator], FloatArray],
    is_inherited: bool,
) -> None:
    count = STARTS if part.start_cov.any() else FEW_STARTS
    with guard_user_code(where):
        starts = _draw_starts(part, seed, start, is_inherited, count)
    demand_array(where, "x(0)", starts[0], (part.n,))
    deviations = np.array(starts) - part.start_mean
    size = 1.0 + float(np.abs(part.start_mean).max())
    rule = "x(0) must be its mean in the directions in which cov has no variance"
    remedy = "start at mean + root of cov times normals"
    unit = whitened(deviations, part.start_cov, size, where, rule, remedy)
    if unit.size:
        check_white(unit[:, None], NoiseLabels(where, "x(0) less its mean", "cov"))


class _SharedNormals:
    """Standard normal numbers for ``count`` runs, drawn from one generator run after run."""

    def __init__(self, random: np.random.Generator, count: int) -> None:
        self._random, self._count = random, count

    def draw(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the next numbers (count, *shape) of all runs."""
        return self._random.standard_normal((self._count, *shape))


def _draw_starts(
    part: Any,
    seed: int,
    start: Callable[[np.random.Generator], FloatArray],
    is_inherited: bool,
    count: int,
) -> Sequence[FloatArray]:
    random = _make_generator(seed, 0)
    first = [start(random) for _ in range(min(count, FEW_STARTS))]
    if is_inherited and type(part).starts is Plant.starts:
        # Drawing them one by one would take most of the time of a check.
        together = part.starts(_SharedNormals(_make_generator(seed, 0), count))
        same = together[: len(first)]
        if np.shape(first) == same.shape and scaled_difference(np.array(first), same) <= ROUNDING:
            return [*first, *together[len(first) :]]
    return [*first, *(start(random) for _ in range(count - len(first)))]


def _check_noise(
    noise: FloatArray, S: FloatArray, states: FloatArray, labels: NoiseLabels, rule: str
) -> None:
    e = whitened(noise, S, 1.0 + float(np.abs(states).max()), labels.where, rule)
    if not e.size:
        return
    check_white(e, labels)
    # The states before each step, and x(0) in units of its own deviations.
    flat_states = states.reshape(-1, states.shape[-1])
    check_independent(e.reshape(len(flat_states), -1), flat_states, labels, "the state before")
    start_factor = whiten(np.atleast_2d(np.cov(states[:, 0].T))).factor
    if start_factor.size and len(e) > 1:
        start = (states[:, 0] - states[:, 0].mean(axis=0)) @ start_factor.T
        check_uncorrelated(start, e[:, 0], labels._replace(noise="x(0) and the noise"), "after it")


def _check_slots(part: LinearPlant, copy: LinearPlant, name: str, seed: int) -> None:
    where = f"{name}.truth"

    def draw_path(plant: Any, slots: Sequence[int], run: int = 0) -> FloatArray:
        with guard_user_code(where):
            truth = plant.truth(_make_generator(seed, run))
            states = [truth.state(slot) for slot in slots]
        demand_array(where, "a state", states[0], (part.n,))
        return np.array([np.asarray(x).reshape(-1) for x in states])

    factor = growth_factor(part.F)
    length = LENGTH
    if factor > 1.0:
        length = max(8, min(LENGTH, int(MAX_LOG_GROWTH / math.log(factor))))
    last = min(SHORT_LENGTH, length)
    slots = list(range(last + 1))
    path = draw_path(part, slots)
    _demand_same(where, path, draw_path(part, slots), "at the second call")
    _demand_same(where, path, draw_path(copy, slots), "of a pickled plant")
    gaps = [0, 0, 3, last // 2, last // 2, last]
    when = "when slots are left out or asked for twice"
    _demand_same(where, path[gaps], draw_path(part, gaps), when)
    with guard_user_code(where):
        # The same run once more, in frames.
        _compare_frames(part, where, path, part.truth(_make_generator(seed, 0), True))
    moved = _move_start(part)
    if moved is not None:
        plant, offset = moved
        Phi = np.array([np.linalg.matrix_power(part.F, k) for k in slots])
        _demand_moved(where, path, draw_path(plant, slots), Phi, offset, "powers of F")
    is_inherited = type(part).truth is LinearPlant.truth
    _check_starts(part, where, seed, lambda random: part.truth(random).state(0), is_inherited)
    runs = max(2, min(MAX_RUNS, STEPS // length))
    states = np.array([draw_path(part, range(length + 1), run) for run in range(runs)])
    noise = states[:, 1:] - states[:, :-1] @ part.F.T
    labels = NoiseLabels(where, "the noise x[k+1] - F x[k]", "Q")
    rule = "x[k+1] must be F x[k] where Q has no noise"
    _check_noise(noise, part.Q, states[:, :-1], labels, rule)


def _compare_frames(part: LinearPlant, where: str, path: FloatArray, truth: Any) -> None:
    frame = truth.frame_slots
    origin = np.zeros(part.n)
    for slot, x in enumerate(path):
        origin = part.F @ origin if slot else origin
        for kind, state in (
            ("absolute", truth.absolute(slot)),
            ("local", truth.local(slot) + origin),
        ):
            error = scaled_difference(np.asarray(state), x)
            rule = f"{kind} states must be the same in frames, up to the origin"
            text = f"{error:.3g} of the state apart in slot {slot}"
            demand(error <= FRAME_TOLERANCE, where, rule, text)
        if frame and slot and slot % frame == 0:
            origin = origin + truth.rebase(slot)
            is_zero = not np.any(truth.local(slot))
            rule = "the local state must be 0 where a frame begins"
            demand(is_zero, where, rule, truth.local(slot))


def _check_diffusion(part: Diffusion, copy: Diffusion, name: str, seed: int) -> None:
    speed, growth = float(np.abs(eigenvalues(part.A)).max()), growth_rate(part.A)
    time_constant = 1.0 / speed if speed > 0.0 else 1.0
    max_seconds = MAX_LOG_GROWTH / growth if growth > 0.0 else math.inf
    is_inherited = type(part).start is Diffusion.start
    _check_starts(part, f"{name}.start", seed, part.start, is_inherited)
    _check_sampled(part, copy, f"{name}.sampled_truth", seed, (time_constant, max_seconds))
    period = part.sensing_period or min(0.1 * time_constant, part.longest_period)
    with_grid = dataclasses.replace(part, sensing_period=period)
    _check_grid(with_grid, name, seed, max(2, int(min(max_seconds / period, 64.0))))


def _check_sampled(
    part: Diffusion, copy: Diffusion, where: str, seed: int, scale: tuple[float, float]
) -> None:
    time_constant, max_seconds = scale
    times = np.cumsum(time_constant * np.tile(GAPS, LENGTH // len(GAPS)))
    # At least eight times, two for each gap, however fast the plant grows.
    times = times[times <= max(max_seconds, times[7])]
    horizon = float(times[-1]) * 1.01

    def draw_path(plant: Any, at: FloatArray, run: int = 0) -> FloatArray:
        random = _make_generator(seed, run)
        truth = call_user_function(where, plant.sampled_truth, random, at, horizon)
        with_start = np.concatenate([[0.0], at])
        states = np.asarray(call_user_function(where, truth.states, with_start)[1])
        return demand_array(where, "states", states, (len(with_start), part.n))

    path = draw_path(part, times)
    _demand_same(where, path, draw_path(part, times), "at the second call")
    _demand_same(where, path, draw_path(copy, times), "of a pickled plant")
    _demand_same(where, path[::3], draw_path(part, times[2::3]), "at every third time alone")
    laws = [transition_law(part.A, part.B, time_constant * gap) for gap in GAPS]
    moved = _move_start(part)
    if moved is not None:
        plant, offset = moved
        Phi_from_start = [np.eye(part.n)]
        for k in range(len(times)):
            Phi_from_start.append(laws[k % len(GAPS)][0] @ Phi_from_start[-1])
        moved_path = draw_path(plant, times)
        _demand_moved(where, path, moved_path, np.array(Phi_from_start), offset, "e^{A t}")
    runs = max(2, min(MAX_RUNS, STEPS // (2 * len(times))))
    states = np.array([draw_path(part, times, run) for run in range(runs)])
    # The gaps repeat after four steps: one law for all steps of each gap.
    for k, (Phi, S) in enumerate(laws):
        after = states[:, k + 1 :: 4]
        before = states[:, k:-1:4][:, : after.shape[1]]
        text = f"the noise x(t + g) - e^(A g) x(t) over {time_constant * GAPS[k]:.3g} s"
        rule = "x(t + g) must be e^(A g) x(t) where B has no noise"
        _check_noise(after - before @ Phi.T, S, before, NoiseLabels(where, text, "B"), rule)


def _check_grid(part: Diffusion, name: str, seed: int, steps: int) -> None:
    where, period = f"{name}.paths", float(part.sensing_period or 0.0)
    blocks = -(-steps // BLOCK)
    probe_times = period * np.array([1.3, 4.0, 5.5, 5.7])
    sample_times = period * np.array([2.5, 5.6])

    def draw_paths(runs: Sequence[int], cut: bool = False) -> Any:
        plant_normals, probe_normals, sample_normals = (
            GeneratorNormals([_make_generator(seed, run, purpose) for run in runs])
            for purpose in ("plant", "probe", "samples")
        )
        no_times = np.empty(0)
        cuts = (no_times, sample_normals, no_times)
        if cut:
            cuts = (probe_times, sample_normals, sample_times)
        paths = call_user_function(where, part.paths, plant_normals, probe_normals, *cuts)
        return paths.following(blocks)

    together = draw_paths(range(3))
    alone = draw_paths([1])
    _demand_same(where, together.x_end[1], alone.x_end[0], "of a run by itself")
    cut = draw_paths([1], cut=True)
    is_last_piece = np.append(np.diff(cut.step) > 0, True)
    when = "at the points of its grid when cut"
    _demand_same(where, alone.x_end[0], cut.x_end[0][is_last_piece], when)
    _check_one_path(part, f"{name}.path", cut, (probe_times, sample_times), seed)
    moved = _move_start(part)
    if moved is not None:
        plant, offset = moved
        normals = (GeneratorNormals([_make_generator(seed, 1, p)]) for p in ("plant", "probe"))
        moved_path = plant.paths(*normals, probe_times[:0]).following(blocks)
        Phi = np.array([scipy.linalg.expm(part.A * period * k) for k in range(1, steps + 1)])
        x, moved_x = alone.x_end[0][:steps], moved_path.x_end[0][:steps]
        _demand_moved(where, x, moved_x, Phi, offset, "e^{A t}")
    runs = max(2, GRID_STEPS // (BLOCK * blocks))
    drawn = draw_paths(range(runs))
    start, end = drawn.x_start[:, :steps], drawn.x_end[:, :steps]
    end_and_moments = np.concatenate([end, *(drawn.moments[:, :steps, m] for m in (0, 1))], axis=2)
    Phi, S = moment_law(part.A, part.B, period)
    # Scaled, so that x and its moments are of one size.
    scale = np.repeat([1.0, 1.0 / period, 1.0 / period], part.n)
    noise = (end_and_moments - start @ Phi.T) * scale
    text = f"the noise of x and its two moments over steps of {period:g} s"
    rule = "x and its moments must follow from the state before where B has no noise"
    labels = NoiseLabels(where, text, "B")
    _check_noise(noise, S * np.outer(scale, scale), start, labels, rule)


def _check_one_path(
    part: Diffusion, where: str, cut: Any, times: tuple[FloatArray, FloatArray], seed: int
) -> None:
    plant_random, probe_random, sample_random = (
        _make_generator(seed, 1, purpose) for purpose in ("plant", "probe", "samples")
    )
    path = call_user_function(
        where, part.path, plant_random, probe_random, times[0], sample_random, times[1]
    )
    # Every probe and sample time is the end of a piece; of all other ends the first ones will do.
    all_times = np.unique(np.concatenate([cut.end[:20], *times]))
    with guard_user_code(where):
        x = np.array([path.local(time) for time in all_times.tolist()])
    pieces = np.searchsorted(cut.end, all_times)
    when = "from the one that `paths` draws for the same run"
    _demand_same(where, cut.x_end[0][pieces], x, when)
