"""``check_plant``: checks of the states of a plant against its matrices; checks of functions and
their Jacobians, of plants and sensors that need not be linear.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy

from netkf.core.errors import NetkfError
from netkf.laws.noise import moment_law, transition_law, whiten
from netkf.linalg.arrays import FloatArray
from netkf.linalg.spectra import eigenvalues, growth_factor, growth_rate
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.dynamics import CustomDynamics
from netkf.plants.linear import LinearPlant
from netkf.plants.maps import NonlinearPlant
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
    checker,
    component_sizes,
    demand,
    demand_array,
    demand_close,
    guard_user_code,
    make_part,
    scaled_difference,
)

STATES, DERIVATIVE_STEP, DERIVATIVE_TOLERANCE = 20, 1e-3, 1e-5
"""States at which f is checked, and the step and relative error of its numerical derivatives."""


def check_dynamics(part: Any, name: str) -> None:
    """Check that f depends on x, u and t alone and has its Jacobian; raises AssertionError."""
    random = Streams(0, 0).generator("dynamics")
    f, period = part.f, getattr(part, "period", 0.0)
    if isinstance(f, CustomDynamics):
        name = f.name.rpartition(":")[2]
    spread = 1.0 + np.sqrt(np.diag(part.start_cov))
    for k in range(STATES):
        x = part.start_mean + spread * random.standard_normal(part.n)
        t = k * (period or 0.1)
        u = np.zeros(part.m) if part.input is None else part.input.at(t)
        u = u + 0.1 * random.standard_normal(part.m)
        with guard_user_code(name):
            own, slope = (lambda x, of=of: of(x, u, t, period) for of in part.functions)  # noqa: B023
            check_derivatives((name, "f", "x, u and t"), own, slope, x)
    if isinstance(f, CustomDynamics) and hasattr(f.part, "kernels") and hasattr(f.part, "f"):
        x = part.start_mean + spread
        value, J = (function(x, u, 0.0, 0.0) for function in part.functions)
        expected = np.asarray(f.part.f(x, u, 0.0))
        demand_close(value[None], expected[None], f"{name}.kernels", "must compute f")
        demand_close(J, f.part.jacobian(x, u, 0.0), f"{name}.kernels", "must compute jacobian")


def check_derivatives(
    names: tuple[str, str, str],
    function: Callable[[FloatArray], Any],
    jacobian: Callable[[FloatArray], Any],
    x: FloatArray,
    difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract,
) -> None:
    """Check that a ``function`` and its ``jacobian`` at ``x`` (n,) are finite, the same once more
    after other calls, and that one is the derivative of the other. ``names`` are those of the
    class, of the function and of what it depends on; ``difference`` subtracts two values.
    """
    name, of, arguments = names
    value, J = np.asarray(function(x.copy())), np.asarray(jacobian(x.copy()))
    function(x + 1.0)
    for again, before, method in ((function, value, of), (jacobian, J, "jacobian")):
        remedy = f"let it depend on {arguments} alone; noise is added by netkf"
        rule = f"must be the same for equal {arguments}"
        demand(np.isfinite(before).all(), f"{name}.{method}", "must be finite", before)
        demand(np.array_equal(again(x.copy()), before), f"{name}.{method}", rule, remedy=remedy)
    rule = f"must be {len(value)} x {len(x)}"
    demand(J.shape == (len(value), len(x)), f"{name}.jacobian", rule, str(J.shape))
    # Differences over two steps, of which the error is of the fourth power of the step.
    near, far = (
        np.stack([difference(*(np.asarray(function(x + s)) for s in (d, -d))) for d in steps], 1)
        for steps in (DERIVATIVE_STEP * size * np.eye(len(x)) for size in (1.0, 2.0))
    )
    error = np.abs((8.0 * near - far) / (12.0 * DERIVATIVE_STEP) - J)
    # Each value has a unit of its own; 0.01 of it allows for rounding where all derivatives are 0.
    sizes = np.abs(J).max(axis=1) + 1e-2 * np.abs(value) + np.finfo(float).tiny
    relative = error / sizes[:, None]
    i, j = np.unravel_index(int(relative.argmax()), error.shape)
    demand(
        float(relative.max()) <= DERIVATIVE_TOLERANCE,
        f"{name}.jacobian",
        f"must be the derivatives of {of}",
        f"entry [{i}, {j}] off by {error[i, j]:.2g} at x = {np.round(x, 3).tolist()}",
        f"compare it with differences of {of}",
    )


STARTS, STEPS, LENGTH = 40_000, 100_000, 400
"""Draws of x(0), steps of the state in all runs together, and steps of a run, for statistics."""
MAP_LENGTH, MAP_RUNS = 40, 100
"""Steps of a run, and runs, of plants that need not be linear."""
FEW_STARTS = 10
"""Draws of x(0) where it is not random."""
GRID_STEPS, MAX_RUNS = 51_200, 2000
"""Steps on the sensing grid in all runs together, and largest number of runs off that grid."""
FRAME_TOLERANCE = 1e-6
"""Relative difference of equal paths in frames."""
MAX_LOG_GROWTH = math.log(1e6)
"""Logarithm of the largest growth of the state of an unstable plant in a run."""
SLOT_TEXTS = "Q", "x[k+1] must be F x[k] where Q has no noise", "powers of F"
FLOW_TEXTS = "B", "x(t + g) must be e^(A g) x(t) where B has no noise", "e^{A t}"
"""What messages say of plants: the field that states the noise, the rule of a step, and of many."""
GAPS = (0.7, 0.2, 1.0, 0.05)
"""Gaps between the times of a path, in units of the time constant of the plant."""


@checker
def check_plant(plant: Any, /, **settings: Any) -> None:
    """Check a plant, or a class with its ``settings``.

    Its law is x(0) of mean ``mean`` and covariance ``cov``, and x[k+1] = F x[k] + w[k] with
    cov(w) = Q, or dx = A x dt + B dw. Where f takes the place of F, it must depend on x, u and t
    alone, and have the Jacobian that is stated; its noise is judged from 4,000 steps.

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
    unknown plants are checked for form and pickle only, and plants without a ``schedule``. A
    correct class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    _check_plant(make_part(plant, (Plant,), settings), 0)


def _check_plant(part: Any, seed: int) -> None:
    watched = WatchedPart(part)
    copy = watched.pickle_copy()
    name = watched.name
    _check_form(part, name)
    if not part.is_random:
        return
    rule = "must be left out: plants are checked as they are between two changes"
    demand(not len(part.changes), f"{name}.schedule", rule, f"{len(part.changes)} changes")
    with watched.guard():
        if not part.linear:
            check_dynamics(part, name)
        if isinstance(part, NonlinearPlant):
            _check_maps(part, copy, name, seed)
        elif isinstance(part, NonlinearDiffusion):
            _check_curve(part, copy, name, seed)
        elif isinstance(part, LinearPlant):
            _check_slots(part, copy, name, seed)
        elif isinstance(part, Diffusion):
            _check_diffusion(part, copy, name, seed)


def _check_maps(part: NonlinearPlant, copy: Any, name: str, seed: int) -> None:
    where, period, steps = f"{name}.truth", part.period, np.arange(MAP_LENGTH)
    f, u = part.functions[0], part.inputs(MAP_LENGTH)

    def draw(plant: Any, run: int = 0) -> FloatArray:
        truth = plant.truth(_make_generator(seed, run))
        return np.array([truth.state(slot) for slot in range(MAP_LENGTH + 1)])

    with guard_user_code(where):
        _demand_same(where, draw(part), draw(copy), "of a pickled plant")
        states = np.array([draw(part, run) for run in range(MAP_RUNS)])
        moved = np.array(
            [[f(x[k], u[k], k * period, period) for k in steps.tolist()] for x in states]
        )
    labels = NoiseLabels(where, "the noise x[k+1] - f(x[k])", "Q")
    rule = "x[k+1] must be f(x[k], u[k], t_k) where Q has no noise"
    _check_noise(states[:, 1:], moved, part.Q, states[:, :-1], labels, rule)


def _check_curve(part: NonlinearDiffusion, copy: Any, name: str, seed: int) -> None:
    where, times = f"{name}.curve", part.step * np.array([0.4, 1.0, 1.7, 5.2])
    probes = part.step * np.array([0.2, 1.5, 3.0, 5.0])

    def draw(plant: Any, probes: FloatArray) -> FloatArray:
        random = [_make_generator(seed, 0, name) for name in ("plant", "samples", "probe")]
        path = plant.curve(random[0], (times, random[1]), (probes, random[2]))
        return np.array([path.absolute(time) for time in times.tolist()])

    with guard_user_code(where):
        alone = draw(part, np.empty(0))
        _demand_same(where, alone, draw(copy, np.empty(0)), "of a pickled plant")
        _demand_same(where, alone, draw(part, probes), "with states at more times")


def _check_form(part: Any, name: str) -> None:
    n = part.n
    matrix = part.F if isinstance(part, LinearPlant) else getattr(part, "A", np.zeros((n, n)))
    fits = isinstance(n, int) and matrix.shape == (n, n)
    demand(fits, f"{name}.n", "must be the number of rows of the plant's matrix", n)
    noise = getattr(part, "Q", np.zeros((n, n)))
    demand(noise.shape == (n, n), f"{name}.Q", f"must have the shape {(n, n)}", str(noise.shape))
    demand_array(f"{name}.start_mean", "the mean of x(0)", part.start_mean, (n,))
    demand_array(f"{name}.start_cov", "the covariance of x(0)", part.start_cov, (n, n))


def _make_generator(seed: int, run: int, purpose: str = "plant") -> np.random.Generator:
    return Streams(seed, run).generator(purpose)


def _demand_same(where: str, one: FloatArray, other: FloatArray, when: str) -> None:
    remedy = "use only the generators given, and draw for each step in order"
    demand_close(one, other, where, "must make the same path from equal streams", when, remedy)


def _check_moved(
    part: Any, where: str, draw: Callable[[Any], FloatArray], transitions: Any, law: str
) -> None:
    """Check that a moved start moves the path (K, n) by ``transitions`` (K, n, n) from it."""
    mean = part.start_mean + 3.0 * (1.0 + np.sqrt(np.diag(part.start_cov)))
    try:
        plant = dataclasses.replace(part, mean=mean)
    except (NetkfError, TypeError, ValueError):
        return
    expected = np.array(transitions) @ (plant.start_mean - part.start_mean)
    if not expected.any():
        return
    x, moved = draw(part), draw(plant)
    largest = np.abs(moved).max(axis=0)
    sizes = np.maximum(largest, np.abs(transitions[1]) @ largest) + np.finfo(float).tiny
    error = np.abs(moved - x - expected) / sizes
    worst = int(error.max(axis=1).argmax())
    rule = f"a start that is moved must move the path by {law}, and the noise not at all"
    got = f"{moved[worst] - x[worst]} instead of {expected[worst]}"
    remedy = "let the noise not depend on x, and use the matrix that the filters are told"
    demand(error.max() <= ROUNDING, where, rule, got, remedy)


def _check_starts(
    part: Any, where: str, seed: int, start: Callable[..., FloatArray], is_inherited: bool
) -> None:
    count = STARTS if part.start_cov.any() else FEW_STARTS
    with guard_user_code(where):
        random, is_same = _make_generator(seed, 0), False
        starts = np.array([start(random) for _ in range(FEW_STARTS)])
        if is_inherited and type(part).starts is Plant.starts:
            # Drawing them one by one would take most of the time of a check.
            together = part.starts(GeneratorNormals([_make_generator(seed, 0)] * count))
            first = together[:FEW_STARTS]
            is_same = starts.shape == first.shape and scaled_difference(starts, first) <= ROUNDING
        rest = range(count - FEW_STARTS)
        more = together[FEW_STARTS:] if is_same else [start(random) for _ in rest]
        starts = np.array([*starts, *more])
    demand_array(where, "x(0)", starts[0], (part.n,))
    sizes = np.maximum(np.abs(part.start_mean), np.abs(starts).max(axis=0))
    rule = "x(0) must be its mean in the directions in which cov has no variance"
    remedy = "start at mean + root of cov times normals"
    unit = whitened(starts - part.start_mean, part.start_cov, sizes, where, rule, remedy)
    if unit.size:
        check_white(unit[:, None], NoiseLabels(where, "x(0) less its mean", "cov"))


def _check_noise(
    after: FloatArray,
    moved: FloatArray,
    S: FloatArray,
    states: FloatArray,
    labels: NoiseLabels,
    rule: str,
) -> None:
    """Check that ``after`` less ``moved`` (R, K, q), of ``states``, has noise covariance ``S``."""
    e = whitened(after - moved, S, component_sizes(after, moved), labels.where, rule)
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


def _check_paths(
    plants: tuple[Any, Any],
    where: str,
    draw: Callable[..., FloatArray],
    at: FloatArray,
    subset: tuple[str, list[int]],
    laws: Sequence[tuple[FloatArray, FloatArray, str]],
    runs: int,
) -> None:
    """Check paths ``draw(plant, at, run)`` (K, n); ``laws`` are Phi and the covariance of w."""
    part, copy = plants
    field, rule, power = SLOT_TEXTS if isinstance(part, LinearPlant) else FLOW_TEXTS
    path, (when, few) = draw(part, at), subset
    _demand_same(where, path, draw(part, at), "at the second call")
    _demand_same(where, path, draw(copy, at), "of a pickled plant")
    _demand_same(where, path[few], draw(part, at[few]), when)
    transitions = [np.eye(part.n)]
    for k in range(len(at) - 1):
        transitions.append(laws[k % len(laws)][0] @ transitions[-1])
    _check_moved(part, where, lambda plant: draw(plant, at), transitions, power)
    states = np.array([draw(part, at, run) for run in range(runs)])
    for k, (Phi, S, noise) in enumerate(laws):
        after = states[:, k + 1 :: len(laws)]
        before = states[:, k : -1 : len(laws)][:, : after.shape[1]]
        _check_noise(after, before @ Phi.T, S, before, NoiseLabels(where, noise, field), rule)


def _check_slots(part: LinearPlant, copy: LinearPlant, name: str, seed: int) -> None:
    where, factor = f"{name}.truth", growth_factor(part.F)

    def draw(plant: Any, slots: FloatArray, run: int = 0) -> FloatArray:
        with guard_user_code(where):
            truth = plant.truth(_make_generator(seed, run))
            states = [truth.state(slot) for slot in map(int, slots)]
        demand_array(where, "a state", states[0], (part.n,))
        return np.array([np.asarray(x).reshape(-1) for x in states])

    length = LENGTH
    if factor > 1.0:
        length = max(8, min(LENGTH, int(MAX_LOG_GROWTH / math.log(factor))))
    slots = np.arange(length + 1.0)
    few = [0, 0, 3, length // 2, length // 2, length]
    subset = "when slots are left out or asked for twice", few
    laws = [(part.F, part.Q, "the noise x[k+1] - F x[k]")]
    runs = max(2, min(MAX_RUNS, STEPS // length))
    is_inherited = type(part).truth is LinearPlant.truth
    _check_paths((part, copy), where, draw, slots, subset, laws, runs)
    path = draw(part, slots)
    with guard_user_code(where):
        # The same run once more, in frames.
        _compare_frames(part, where, path, part.truth(_make_generator(seed, 0), True))
    _check_starts(part, where, seed, lambda random: part.truth(random).state(0), is_inherited)


def _compare_frames(part: LinearPlant, where: str, path: FloatArray, truth: Any) -> None:
    frame, origin = truth.frame_slots, np.zeros(part.n)
    for slot, x in enumerate(path):
        origin = part.F @ origin if slot else origin
        sizes = component_sizes(path[: slot + 1])
        states = {"absolute": truth.absolute(slot), "local": truth.local(slot) + origin}
        for kind, state in states.items():
            error = float((np.abs(np.asarray(state) - x) / sizes).max())
            rule = f"{kind} states must be the same in frames, up to the origin"
            text = f"{error:.3g} of the state apart in slot {slot}"
            demand(error <= FRAME_TOLERANCE, where, rule, text)
        if frame and slot and slot % frame == 0:
            origin = origin + truth.rebase(slot)
            rule = "the local state must be 0 where a frame begins"
            demand(not np.any(truth.local(slot)), where, rule, truth.local(slot))


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
    times = np.concatenate([[0.0], times[times <= max(max_seconds, times[7])]])
    horizon = float(times[-1]) * 1.01

    def draw(plant: Any, at: FloatArray, run: int = 0) -> FloatArray:
        with guard_user_code(where):
            truth = plant.sampled_truth(_make_generator(seed, run), at[1:], horizon)
            states = np.asarray(truth.states(at)[1])
        return demand_array(where, "states", states, (len(at), part.n))

    laws = []
    for gap in (time_constant * np.array(GAPS)).tolist():
        text = f"the noise x(t + g) - e^(A g) x(t) over {gap:.3g} s"
        laws.append((*transition_law(part.A, part.B, gap), text))
    subset = "at every third time alone", list(range(0, len(times), 3))
    runs = max(2, min(MAX_RUNS, STEPS // (2 * len(times))))
    _check_paths((part, copy), where, draw, times, subset, laws, runs)


def _check_grid(part: Diffusion, name: str, seed: int, steps: int) -> None:
    where, period = f"{name}.paths", float(part.sensing_period or 0.0)
    blocks = -(-steps // BLOCK)
    probe_times = period * np.array([1.3, 4.0, 5.5, 5.7])
    sample_times = period * np.array([2.5, 5.6])

    def draw_paths(runs: Sequence[int], cut: bool = False, plant: Any = part) -> Any:
        plant_normals, probe_normals, sample_normals = (
            GeneratorNormals([_make_generator(seed, run, purpose) for run in runs])
            for purpose in ("plant", "probe", "samples")
        )
        probes, samples = (times if cut else times[:0] for times in (probe_times, sample_times))
        with guard_user_code(where):
            paths = plant.paths(plant_normals, probe_normals, probes, sample_normals, samples)
        return paths.following(blocks)

    together = draw_paths(range(3))
    alone = draw_paths([1])
    _demand_same(where, together.x_end[1], alone.x_end[0], "of a run by itself")
    cut = draw_paths([1], cut=True)
    is_last_piece = np.append(np.diff(cut.step) > 0, True)
    when = "at the points of its grid when cut"
    _demand_same(where, alone.x_end[0], cut.x_end[0][is_last_piece], when)
    _check_one_path(part, f"{name}.path", cut, (probe_times, sample_times), seed)
    powers = [scipy.linalg.expm(part.A * period * k) for k in range(1, steps + 1)]
    draw = lambda plant: np.asarray(draw_paths([1], plant=plant).x_end[0][:steps])  # noqa: E731
    _check_moved(part, where, draw, powers, "e^{A t}")
    drawn = draw_paths(range(max(2, GRID_STEPS // (BLOCK * blocks))))
    start, end = drawn.x_start[:, :steps], drawn.x_end[:, :steps]
    end_and_moments = np.concatenate([end, *(drawn.moments[:, :steps, m] for m in (0, 1))], axis=2)
    Phi, S = moment_law(part.A, part.B, period)
    # Scaled, so that x and its moments are of one size.
    scale = np.repeat([1.0, 1.0 / period, 1.0 / period], part.n)
    after, moved = end_and_moments * scale, start @ Phi.T * scale
    text = f"the noise of x and its two moments over steps of {period:g} s"
    rule = "x and its moments must follow from the state before where B has no noise"
    labels = NoiseLabels(where, text, "B")
    _check_noise(after, moved, S * np.outer(scale, scale), start, labels, rule)


def _check_one_path(
    part: Diffusion, where: str, cut: Any, times: tuple[FloatArray, FloatArray], seed: int
) -> None:
    plant_random, probe_random, sample_random = (
        _make_generator(seed, 1, purpose) for purpose in ("plant", "probe", "samples")
    )
    # Every probe and sample time is the end of a piece; of all other ends the first ones will do.
    all_times = np.unique(np.concatenate([cut.end[:20], *times]))
    with guard_user_code(where):
        path = part.path(plant_random, probe_random, times[0], sample_random, times[1])
        x = np.array([path.local(time) for time in all_times.tolist()])
    pieces = np.searchsorted(cut.end, all_times)
    when = "from the one that `paths` draws for the same run"
    _demand_same(where, cut.x_end[0][pieces], x, when)
