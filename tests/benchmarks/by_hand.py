"""Hand-written numba kernels of whole runs, one for each filter, which set the limits of speed.

Each does one job and nothing else, as a competent person would write it: one compiled call makes
all runs, draws truth, readings, links and losses inside the loop and keeps x, xhat and P at the
probes, without a trace. Covariance form, no allocation in a step. Nothing of netkf is used;
tests/benchmarks/test_by_hand.py holds the statistics of both against each other.

Arrays are float64 or int64, ``random`` is a ``numpy.random.Generator``, ``size`` a tuple of n
zeros: its length is known when the kernel is compiled, so that loops over states are unrolled (two
to three times as fast, and inlining all helpers gains as much again). R runs, T probes, N nodes,
L links, n states, p rows of a reading. Results: ``x`` (R, T, n), ``xhat`` (R, T, N, n), ``P``
(R, T, N, n, n).
"""

import numba
import numpy as np

kernel = numba.njit(nogil=True, error_model="numpy", fastmath=True, cache=True, forceinline=True)

STEP = 0.125
"""Seconds: of the grid on which the path of a diffusion is drawn, and the longest time over which
readings are summed up, in two moments, before they are used. P is a millionth larger for it than
that of a Kalman-Bucy filter in these examples, about what netkf's readings are off; a grid twice as
wide makes that 2e-5, and a run of few nodes a quarter faster.
"""

SPAN, BINS, ORDER = 1.0, 16, 4
"""Laws of a gap of at most SPAN seconds: a polynomial about the middle of each of BINS parts."""

POISSON, GAMMA, LATTICE = range(3)
"""Kinds of clocks."""
RESET, SWAP, INTERSECT, SUMS = range(4)
"""What nodes do with what they hear."""


# Steps of a Kalman filter


@kernel
def predict(size, F, Q, m, S, k, work):
    """m <- F m, S <- F S F' + Q of entry k of m (K, n) and S (K, n, n); ``work`` (n + 1, n)."""
    n = len(size)
    for i in range(n):
        for j in range(n):
            s = 0.0
            for c in range(n):
                s += F[i, c] * S[k, c, j]
            work[i, j] = s
        s = 0.0
        for c in range(n):
            s += F[i, c] * m[k, c]
        work[n, i] = s
    for i in range(n):
        m[k, i] = work[n, i]
        for j in range(i + 1):
            s = Q[i, j]
            for c in range(n):
                s += work[i, c] * F[j, c]
            S[k, i, j] = s
            S[k, j, i] = s


@kernel
def update(size, y, H, node, row, m, S, k, gain):
    """Use the scalar reading y = h x + v, h = H[node, row], var(v) = 1, in entry k; ``gain`` (n,)
    is work.
    """
    n = len(size)
    s, d = 1.0, y
    for i in range(n):
        g = 0.0
        for j in range(n):
            g += S[k, i, j] * H[node, row, j]
        gain[i] = g
        s += H[node, row, i] * g
        d -= H[node, row, i] * m[k, i]
    s = 1.0 / s
    for i in range(n):
        g = gain[i] * s
        m[k, i] += g * d
        for j in range(n):
            S[k, i, j] -= g * gain[j]


@kernel
def invert(size, S, k):
    """S[k]^-1 in place, of a positive definite matrix: sweeps over the diagonal."""
    n = len(size)
    for pivot in range(n):
        d = 1.0 / S[k, pivot, pivot]
        for i in range(n):
            if i != pivot:
                f = S[k, i, pivot] * d
                for j in range(n):
                    if j != pivot:
                        S[k, i, j] -= f * S[k, pivot, j]
                S[k, i, pivot] = -f
        for j in range(n):
            S[k, pivot, j] *= d
        S[k, pivot, pivot] = d


@kernel
def read(size, random, H, node, row, x):
    """h x + v, h = H[node, row], var(v) = 1."""
    s = random.standard_normal()
    for i in range(len(size)):
        s += H[node, row, i] * x[i]
    return s


@kernel
def draw_state(size, random, mean, root, x):
    """x ~ N(mean, root root')."""
    n = len(size)
    for i in range(n):
        x[i] = mean[i]
    for j in range(n):
        z = random.standard_normal()
        for i in range(n):
            x[i] += root[i, j] * z


@kernel
def move_state(size, random, F, root, x, work):
    """x <- F x + w, cov(w) = root root'."""
    n = len(size)
    for i in range(n):
        work[i] = 0.0
    for j in range(n):
        z, v = random.standard_normal(), x[j]
        for i in range(n):
            work[i] += F[i, j] * v + root[i, j] * z
    for i in range(n):
        x[i] = work[i]


@kernel
def start_filters(mean, cov, m, S):
    """Every node knows mean and covariance of x(0)."""
    for k in range(len(m)):
        m[k] = mean
        S[k] = cov


@kernel
def keep(size, truth, m, S, run, probe, x, xhat, P):
    """The states of all nodes as results of a probe."""
    n = len(size)
    for i in range(n):
        x[run, probe, i] = truth[i]
    for k in range(len(m)):
        for i in range(n):
            xhat[run, probe, k, i] = m[k, i]
            for j in range(n):
                P[run, probe, k, i, j] = S[k, i, j]


# The gossip filter


@kernel
def keep_places(size, truth, m, S, at, run, probe, x, xhat, P):
    """``keep``, node k is at place ``at[k]``."""
    n = len(size)
    for i in range(n):
        x[run, probe, i] = truth[i]
    for k in range(len(at)):
        for i in range(n):
            xhat[run, probe, k, i] = m[at[k], i]
            for j in range(n):
                P[run, probe, k, i, j] = S[at[k], i, j]


@kernel
def draw_matching(random, ends, order, paired):
    """Links (L, 2) in random order, each taken if both ends are free: ``paired`` (N,) says with
    whom, a node that stays alone with itself.
    """
    for i in range(len(paired)):
        paired[i] = i
    for k in range(len(order) - 1, -1, -1):
        other = int(random.random() * (k + 1))
        link = order[other]
        order[other], order[k] = order[k], link
        i, j = ends[link, 0], ends[link, 1]
        if paired[i] == i and paired[j] == j:
            paired[i], paired[j] = j, i


@kernel
def gossip(size, random, probe, plant, start, H, rows, ends, x, xhat, P):
    """Gossip along random maximal matchings; states are predictions, one every ``probe`` slots.

    ``plant`` is F, Q and a root of Q; ``start`` mean, covariance and its root; the first
    ``rows[i]`` rows of ``H[i]`` (p, n) are those of node i, readings have noise of variance 1.
    """
    n, (runs, times, N, _) = len(size), xhat.shape
    F, Q, root = plant
    m, S = np.empty((N, n)), np.empty((N, n, n))
    truth, line, work = np.empty(n), np.empty(n), np.empty((n + 1, n))
    order, paired, at = np.arange(len(ends)), np.empty(N, np.int64), np.empty(N, np.int64)
    for r in range(runs):
        draw_state(size, random, start[0], start[2], truth)
        start_filters(start[0], start[1], m, S)
        at[:] = np.arange(N)
        for slot in range((times - 1) * probe + 1):
            if slot % probe == 0:
                keep_places(size, truth, m, S, at, r, slot // probe, x, xhat, P)
            if slot > 0:
                draw_matching(random, ends, order, paired)
                for i in range(N):  # nodes swap the places of their states
                    if i < paired[i]:
                        at[i], at[paired[i]] = at[paired[i]], at[i]
            for i in range(N):
                for row in range(rows[i]):
                    y = read(size, random, H, i, row, truth)
                    update(size, y, H, i, row, m, S, at[i], line)
                predict(size, F, Q, m, S, at[i], work)
            move_state(size, random, F, root, truth, line)


# The Kalman filter with intermittent observations


@kernel
def intermittent(size, random, probe, plant, start, H, rows, ends, delivery, x, xhat, P):
    """Each node uses its own readings and those of its neighbours that arrive, in one direction
    with the other; predictions; arguments as for ``gossip``.
    """
    n, (runs, times, N, _) = len(size), xhat.shape
    F, Q, root = plant
    m, S, y = np.empty((N, n)), np.empty((N, n, n)), np.empty(H.shape[:2])
    truth, line, work = np.empty(n), np.empty(n), np.empty((n + 1, n))
    for r in range(runs):
        draw_state(size, random, start[0], start[2], truth)
        start_filters(start[0], start[1], m, S)
        for slot in range((times - 1) * probe + 1):
            if slot % probe == 0:
                keep(size, truth, m, S, r, slot // probe, x, xhat, P)
            for i in range(N):
                for row in range(rows[i]):
                    y[i, row] = read(size, random, H, i, row, truth)
                    update(size, y[i, row], H, i, row, m, S, i, line)
            for link in range(len(ends)):
                if random.random() < delivery:
                    for side in range(2):
                        i, j = ends[link, side], ends[link, 1 - side]
                        for row in range(rows[i]):
                            update(size, y[i, row], H, i, row, m, S, j, line)
            for i in range(N):
                predict(size, F, Q, m, S, i, work)
            move_state(size, random, F, root, truth, line)


# The diffusion filter


@kernel
def combine(size, first, senders, weights, m, S, Y, z, k, xhat):
    """Covariance intersection at node k: S^-1 = sum w Y, m = S sum w z, where Y (N, n, n) and
    z (N, n) are information and information times estimate; the senders of node k, itself among
    them, are ``senders[first[k]:first[k + 1]]``, each with its weight.
    """
    n = len(size)
    for i in range(n):
        xhat[i] = 0.0
        for j in range(n):
            S[k, i, j] = 0.0
    for e in range(first[k], first[k + 1]):
        w, other = weights[e], senders[e]
        for i in range(n):
            xhat[i] += w * z[other, i]
            for j in range(n):
                S[k, i, j] += w * Y[other, i, j]
    invert(size, S, k)
    for i in range(n):
        s = 0.0
        for j in range(n):
            s += S[k, i, j] * xhat[j]
        m[k, i] = s


@kernel
def diffusion(size, random, probe, plant, believed, noise, start, regressors, senders, x, xhat, P):
    """Regression: update, predict, combine with the neighbours; predictions.

    ``plant`` is F and a root of Q, ``believed`` the filters' Q and standard deviation of a reading,
    ``noise`` the true one; ``start`` mean and root of x(0), mean and covariance of the filters;
    ``regressors``: A, B with a root of cov(xi), C and the start of each node's, (N, ...);
    ``senders``: offsets (N + 1,), senders and weights.
    """
    n, (runs, times, N, _) = len(size), xhat.shape
    (A, B, C, first_s), (F, root), (Q, sigma) = regressors, plant, believed
    m, S, Y, z = np.empty((N, n)), np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n))
    truth, line, work = np.empty(n), np.empty(n), np.empty((n + 1, n))
    s, phi, moved = np.empty(first_s.shape), np.empty((1, 1, n)), np.empty(first_s.shape[1])
    white = 1.0 / sigma
    for r in range(runs):
        draw_state(size, random, start[0], start[1], truth)
        start_filters(start[2], start[3], m, S)
        s[:] = first_s
        for slot in range((times - 1) * probe + 1):
            if slot % probe == 0:
                keep(size, truth, m, S, r, slot // probe, x, xhat, P)
            for k in range(N):
                y = noise * random.standard_normal()
                for i in range(n):
                    v = 0.0
                    for j in range(s.shape[1]):
                        v += C[k, i, j] * s[k, j]
                    y += v * truth[i]
                    phi[0, 0, i] = v * white
                update(size, y * white, phi, 0, 0, m, S, k, line)
                predict(size, F, Q, m, S, k, work)
                for i in range(len(moved)):
                    moved[i] = 0.0
                    for j in range(len(moved)):
                        moved[i] += A[k, i, j] * s[k, j]
                for j in range(B.shape[2]):
                    xi = random.standard_normal()
                    for i in range(len(moved)):
                        moved[i] += B[k, i, j] * xi
                for i in range(len(moved)):
                    s[k, i] = moved[i]
                for i in range(n):
                    for j in range(n):
                        Y[k, i, j] = S[k, i, j]
                invert(size, Y, k)
                for i in range(n):
                    z[k, i] = 0.0
                    for j in range(n):
                        z[k, i] += Y[k, i, j] * m[k, j]
            for k in range(N):
                combine(size, senders[0], senders[1], senders[2], m, S, Y, z, k, line)
            move_state(size, random, F, root, truth, line)


# The push-sum filter


@kernel
def exchange_mass(size, random, ends, share, delivery, mass, before):
    """Each end of a link that is up sends its share, one over its degree plus 1, of its mass."""
    n = len(size)
    entries = 2 + n * (n + 1) // 2
    for i in range(len(mass)):
        for e in range(entries):
            before[i, e] = share[i] * mass[i, e]
    for link in range(len(ends)):
        if random.random() < delivery:
            i, j = ends[link, 0], ends[link, 1]
            for e in range(entries):
                d = before[j, e] - before[i, e]
                mass[i, e] += d
                mass[j, e] -= d


@kernel
def average(size, random, ends, delivery, factor, m, z):
    """One averaging step over the links that are up."""
    n = len(size)
    for i in range(len(m)):
        for a in range(n):
            z[i, a] = m[i, a]
    for link in range(len(ends)):
        if random.random() < delivery:
            i, j = ends[link, 0], ends[link, 1]
            for a in range(n):
                d = factor * (z[j, a] - z[i, a])
                m[i, a] += d
                m[j, a] -= d


@kernel
def use_network(size, y, H, rows, own, mass, m, S, k, line):
    """S <- (S^-1 + G)^-1 with what node k takes the information G of the network to be, and its own
    readings with N times the gain, N what it takes the number of nodes to be.
    """
    n, number = len(size), 1.0
    invert(size, S, k)
    if mass[k, 0] > 0.0:
        factor = 1.0 / mass[k, 0]
        number = mass[k, 1] * factor
        for i in range(n):
            for j in range(i + 1):
                S[k, i, j] += factor * mass[k, 2 + i * (i + 1) // 2 + j]
                S[k, j, i] = S[k, i, j]
    else:
        for i in range(n):
            for j in range(n):
                S[k, i, j] += own[k, i, j]
    invert(size, S, k)
    if rows[k]:
        for i in range(n):
            line[i] = 0.0
        for row in range(rows[k]):
            d = y[row]
            for i in range(n):
                d -= H[k, row, i] * m[k, i]
            for i in range(n):
                line[i] += d * H[k, row, i]
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += S[k, i, j] * line[j]
            m[k, i] += number * s


@kernel
def push_sum(size, random, probe, plant, start, H, rows, ends, delivery, steps, factor, x, xhat, P):
    """Push-sum with ``steps`` averaging steps of gain ``factor``; estimates, one every ``probe``
    slots. Node 0 starts with the weight; links fail anew in each exchange, both ways at once;
    arguments as for ``gossip``.
    """
    n, (runs, times, N, _) = len(size), xhat.shape
    F, Q, root = plant
    m, S, z, y = np.empty((N, n)), np.empty((N, n, n)), np.empty((N, n)), np.empty(H.shape[1])
    truth, line, work = np.empty(n), np.empty(n), np.empty((n + 1, n))
    share, own = np.ones(N), np.zeros((N, n, n))
    mass, before = np.empty((N, 2 + n * (n + 1) // 2)), np.empty((N, 2 + n * (n + 1) // 2))
    for i, j in ends:
        share[i] += 1.0
        share[j] += 1.0
    share[:] = 1.0 / share
    for k in range(N):
        for row in range(rows[k]):
            own[k] += np.outer(H[k, row], H[k, row])
    for r in range(runs):
        draw_state(size, random, start[0], start[2], truth)
        start_filters(start[0], start[1], m, S)
        for k in range(N):
            mass[k, 0], mass[k, 1] = k == 0, 1.0
            for i in range(n):
                for j in range(i + 1):
                    mass[k, 2 + i * (i + 1) // 2 + j] = own[k, i, j]
        for slot in range((times - 1) * probe + 1):
            if slot > 0:
                move_state(size, random, F, root, truth, line)
                exchange_mass(size, random, ends, share, delivery, mass, before)
                for k in range(N):
                    predict(size, F, Q, m, S, k, work)
                    for row in range(rows[k]):
                        y[row] = read(size, random, H, k, row, truth)
                    use_network(size, y, H, rows, own, mass, m, S, k, line)
                for _ in range(steps):
                    average(size, random, ends, delivery, factor, m, z)
            if slot % probe == 0:
                keep(size, truth, m, S, r, slot // probe, x, xhat, P)


# Clocks, losses and delays


@kernel
def sift(heap, owner, k):
    """Move entry k of a binary heap of times (K,) and their owners towards the first."""
    t, e = heap[k], owner[k]
    while k > 0:
        up = (k - 1) // 2
        if heap[up] <= t:
            break
        heap[k], owner[k] = heap[up], owner[up]
        k = up
    heap[k], owner[k] = t, e


@kernel
def sink(heap, owner, count):
    """Move the first of ``count`` entries of a heap to its place."""
    t, e, k = heap[0], owner[0], 0
    while True:
        down = 2 * k + 1
        if down >= count:
            break
        if down + 1 < count and heap[down + 1] < heap[down]:
            down += 1
        if heap[down] >= t:
            break
        heap[k], owner[k] = heap[down], owner[down]
        k = down
    heap[k], owner[k] = t, e


@kernel
def tick_after(random, clock, e, t, phase, number):
    """When clock e ticks next after its tick at t. ``clock``: its kind and POISSON the mean gap;
    GAMMA shape and scale of gaps; LATTICE the period, from ``phase[e]`` on, and the jitter.
    """
    kind, first, second = clock
    if kind == POISSON:
        return t + first * random.standard_exponential()
    if kind == GAMMA:
        return t + second * random.standard_gamma(first)
    number[e] += 1
    return phase[e] + (number[e] - 1) * first + second * random.random()


@kernel
def start_clock(random, clock, e, phase, number, heap, owner):
    """Enter the first tick of clock e as entry e of the heap; phases are random."""
    phase[e], number[e] = clock[1] * random.random() if clock[0] == LATTICE else 0.0, 0
    heap[e], owner[e] = tick_after(random, clock, e, 0.0, phase, number), e
    sift(heap, owner, e)


@kernel
def start_chains(random, loss, bad):
    """Draw the state of each link's chain; ``loss``: probabilities of delivery (2, L) in a good and
    a bad state, and of turning bad and good.
    """
    _, to_bad, to_good = loss
    for link in range(len(bad)):
        bad[link] = to_bad > 0.0 and random.random() * (to_bad + to_good) < to_bad


@kernel
def arrives(random, u, loss, bad, link):
    """Whether the next message of a link does, u uniform."""
    delivery, to_bad, to_good = loss
    if to_bad > 0.0:
        bad[link] = random.random() < (1.0 - to_good if bad[link] else to_bad)
    return u < delivery[bad[link], link]


# Pairs in continuous time: the hybrid filter, gossip and covariance intersection


@kernel
def integrals(size, random, F, root, path):
    """``path`` (K, 3 n): state, its integral from time 0 and the integral of that, on a grid;
    transition (3 n, 3 n) and a root of the covariance over a step.
    """
    for k in range(len(path) - 1):
        for i in range(3 * len(size)):
            path[k + 1, i] = 0.0
        for j in range(3 * len(size)):
            z, v = random.standard_normal(), path[k, j]
            for i in range(3 * len(size)):
                path[k + 1, i] += F[i, j] * v + root[i, j] * z


@kernel
def integral(size, path, k, u, H, r):
    """H[r] times both integrals of x at time (k + u) STEP: the quintic that agrees with the second
    integral, the first one and the state at both ends of the step.
    """
    n, x, first, second, dx, d_first, d_second = len(size), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        h = H[r, i]
        x += h * path[k, i]
        dx += h * (path[k + 1, i] - path[k, i])
        first += h * path[k, n + i]
        d_first += h * (path[k + 1, n + i] - path[k, n + i])
        second += h * path[k, 2 * n + i]
        d_second += h * (path[k + 1, 2 * n + i] - path[k, 2 * n + i])
    # Derivatives by u; what the parabola from the start of the step lacks at its end.
    x, dx, first = STEP * STEP * x, STEP * STEP * dx, STEP * first
    d = STEP * d_first - x
    e = d_second - first - 0.5 * x
    a, b, c = 10.0 * e - 4.0 * d + 0.5 * dx, 7.0 * d - 15.0 * e - dx, 6.0 * e - 3.0 * d + 0.5 * dx
    second += u * (first + u * (0.5 * x + u * (a + u * (b + u * c))))
    first += u * (x + u * (3.0 * a + u * (4.0 * b + u * 5.0 * c)))
    return first / STEP, second


@kernel
def laws(table, gap, count, law):
    """The first ``count`` entries of the table (BINS, ORDER + 1, E) at a gap of at most SPAN."""
    k = min(int(gap * (BINS / SPAN)), BINS - 1)
    s = gap - (k + 0.5) * (SPAN / BINS)
    for e in range(count):  # a number known when it runs: one loop over vectors
        v = table[k, ORDER, e]
        for j in range(ORDER - 1, -1, -1):
            v = table[k, j, e] + s * v
        law[e] = v


@kernel
def move(size, law, m, S, k, work):
    """``predict`` with F and the lower triangle of Q from the start of ``law``."""
    n = len(size)
    for i in range(n):
        for j in range(n):
            s = 0.0
            for c in range(n):
                s += law[i * n + c] * S[k, c, j]
            work[i, j] = s
        s = 0.0
        for c in range(n):
            s += law[i * n + c] * m[k, c]
        work[n, i] = s
    for i in range(n):
        m[k, i] = work[n, i]
        for j in range(i + 1):
            s = law[n * n + i * (i + 1) // 2 + j]
            for c in range(n):
                s += work[i, c] * law[j * n + c]
            S[k, i, j] = s
            S[k, j, i] = s


@kernel
def flow(size, both, law, dy, m, S, k, E, d, work):
    """Move over a gap and use the moments ``dy`` (q,) of the readings over it.

    ``law`` is F, lower triangle of Q; W (q, n) with E dy = W xhat; C (n, q), the covariance of what
    noise adds to the state and to the moments; lower triangle of the variance S0 of the latter and
    of the noise of readings. Gain and new covariance are those of E = F P W' + C and W P W' + S0.
    """
    n, q = len(size), len(both)
    W = n * n + n * (n + 1) // 2
    C = W + q * n
    S0 = C + n * q
    # E (n + q, q): P W' below, whose product with F comes above
    for r in range(q):
        d[r] = dy[r]
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += S[k, i, j] * law[W + r * n + j]
            work[n + 1 + r, i] = s
            d[r] -= law[W + r * n + i] * m[k, i]
        for i in range(n):
            s = law[C + i * q + r]
            for j in range(n):
                s += law[i * n + j] * work[n + 1 + r, j]
            E[r, i] = s
    move(size, law, m, S, k, work)
    # Elimination row by row: reading r is used with what the rows before it left.
    for r in range(q):
        for c in range(r + 1):
            s = law[S0 + r * (r + 1) // 2 + c]
            for j in range(n):
                s += law[W + r * n + j] * work[n + 1 + c, j]
            E[q + r, c] = s
    for r in range(q):
        v = 1.0 / E[q + r, r]
        for i in range(n):
            g = E[r, i] * v
            m[k, i] += g * d[r]
            for j in range(n):
                S[k, i, j] -= g * E[r, j]
        for c in range(r + 1, q):
            f = E[q + c, r] * v
            d[c] -= f * d[r]
            for i in range(n):
                E[c, i] -= f * E[r, i]
            for b in range(r + 1, c + 1):
                E[q + c, b] -= f * E[q + b, r]


@kernel
def use_readings(
    size, both, random, table, H, noise, path, end, gap, k, used, m, S, law, dy, E, d, work
):
    """Node k over the gap that ends at time ``end``: draw and use its readings, by their moments
    with the Legendre polynomials 1 and 2 s / gap - 1, s from 0 to ``gap``.
    """
    laws(table, gap, len(law), law)
    cell, p = min(int(end / STEP), len(path) - 2), len(noise)
    for r in range(p):
        first, second = integral(size, path, cell, end / STEP - cell, H, r)
        dy[r] = first - used[k, r]
        dy[p + r] = dy[r] - 2.0 / gap * (second - used[k, p + r] - gap * used[k, r])
        used[k, r], used[k, p + r] = first, second
    roots = np.sqrt(gap), np.sqrt(gap / 3.0)
    for j in range(2):
        for c in range(p):
            z = roots[j] * random.standard_normal()
            for r in range(c, p):
                dy[j * p + r] += noise[r, c] * z
    flow(size, both, law, dy, m, S, k, E, d, work)


@kernel
def advance(
    size, both, random, table, H, noise, path, t, k, rows, now, used, m, S, law, dy, E, d, work
):
    """Node k to time t in steps of at most SPAN, those with readings of at most STEP."""
    longest = STEP if rows[k] else SPAN
    while now[k] < t:
        gap = min(t - now[k], longest)
        end = t if t - now[k] <= longest else now[k] + longest
        if rows[k]:
            use_readings(
                size,
                both,
                random,
                table,
                H,
                noise,
                path,
                end,
                gap,
                k,
                used,
                m,
                S,
                law,
                dy,
                E,
                d,
                work,
            )
        else:
            laws(table, gap, len(size) ** 2 + len(size) * (len(size) + 1) // 2, law)
            move(size, law, m, S, k, work)
        now[k] = end


@kernel
def reset(size, epsilon, i, j, m, S):
    """Both ends move to each other, with what both were before."""
    n = len(size)
    for a in range(n):
        v = epsilon * (m[j, a] - m[i, a])
        m[i, a] += v
        m[j, a] -= v
        for b in range(n):
            v = epsilon * (S[j, a, b] - S[i, a, b])
            S[i, a, b] += v
            S[j, a, b] -= v


@kernel
def swap(size, i, j, m, S):
    """Exchange entries i and j."""
    n = len(size)
    for a in range(n):
        m[i, a], m[j, a] = m[j, a], m[i, a]
        for b in range(n):
            S[i, a, b], S[j, a, b] = S[j, a, b], S[i, a, b]


@kernel
def invert_entry(size, k, m, S, line):
    """Entry k from xhat and P to P^-1 xhat and P^-1, or back."""
    n = len(size)
    invert(size, S, k)
    for i in range(n):
        line[i] = 0.0
        for j in range(n):
            line[i] += S[k, i, j] * m[k, j]
    for i in range(n):
        m[k, i] = line[i]


@kernel
def meet(size, rule, epsilon, i, j, m, S, line):
    """What both ends of a link do when both hear each other."""
    if rule == SWAP:
        swap(size, i, j, m, S)
    elif rule == RESET:
        reset(size, epsilon, i, j, m, S)
    else:
        for k in (i, j):
            invert_entry(size, k, m, S, line)
        reset(size, epsilon, i, j, m, S)
        for k in (i, j):
            invert_entry(size, k, m, S, line)


@kernel
def pairs(
    size, both, random, times, step_law, table, start, sensor, rows, ends, clock, loss, rule,
    epsilon, x, xhat, P,
):  # fmt: skip
    """Kalman-Bucy filters whose pairs meet when their link ticks and nothing is lost.

    ``times`` (T,) are multiples of STEP; ``step_law`` of state and integrals over STEP; ``table``
    of ``flow``; ``start`` mean, covariance and its root; ``sensor`` H (p, n) and a root of the
    noise intensity, of nodes whose ``rows`` is not 0; ``clock`` of ``tick_after``; ``loss`` of
    ``arrives``, both messages at once; ``both`` has length q = 2 p. Returns the number of ticks.
    """
    n, q, (runs, _, N, _), (H, noise) = len(size), len(both), xhat.shape, sensor
    m, S, now, used = np.empty((N, n)), np.empty((N, n, n)), np.empty(N), np.empty((N, q))
    path = np.zeros((int(times[-1] / STEP + 0.5) + 1, 3 * n))
    E, work = np.empty((2 * q, max(n, q))), np.empty((n + 1 + q, n))
    law, dy, d, ticks = np.empty(table.shape[2]), np.empty(q), np.empty(q), 0
    L, t, link, u = len(ends), 0.0, 0, 0.0
    heap, owner, phase = np.empty(L), np.empty(L, np.int64), np.empty(L)
    number, bad = np.empty(L, np.int64), np.empty(L, np.int64)
    together = clock[0] == POISSON  # all of them are one clock
    for r in range(runs):
        draw_state(size, random, start[0], start[2], path[0])
        integrals(size, random, step_law[0], step_law[1], path)
        start_filters(start[0], start[1], m, S)
        start_chains(random, loss, bad)
        now[:], used[:], t = 0.0, 0.0, 0.0
        if together:
            t = clock[1] / L * random.standard_exponential()
        else:
            for e in range(L):
                start_clock(random, clock, e, phase, number, heap, owner)
            t = heap[0]
        for probe in range(len(times)):
            while t <= times[probe]:
                ticks += 1
                u = random.random()
                if together:
                    u *= L
                    link = int(u)
                    u -= link
                else:
                    link = owner[0]
                if arrives(random, u, loss, bad, link):  # else nothing happens
                    i, j = ends[link, 0], ends[link, 1]
                    for k in (i, j):
                        advance(
                            size, both, random, table, H, noise, path, t, k, rows, now, used, m, S,
                            law, dy, E, d, work,
                        )  # fmt: skip
                    meet(size, rule, epsilon, i, j, m, S, d)
                if together:
                    t += clock[1] / L * random.standard_exponential()
                else:
                    heap[0] = tick_after(random, clock, link, t, phase, number)
                    sink(heap, owner, L)
                    t = heap[0]
            for k in range(N):
                advance(
                    size, both, random, table, H, noise, path, times[probe], k, rows, now, used, m,
                    S, law, dy, E, d, work,
                )  # fmt: skip
            keep(size, path[int(times[probe] / STEP + 0.5)], m, S, r, probe, x, xhat, P)
    return ticks


# Broadcasts by clocks of nodes, with sampled sensors and messages under way: covariance
# intersection, and push-sum by running sums


@kernel
def move_to(size, table, t, k, now, m, S, law, work):
    """Entry k from ``now[k]`` to time t, in steps of at most SPAN."""
    while now[k] < t:
        gap = min(t - now[k], SPAN)
        laws(table, gap, len(law), law)
        move(size, law, m, S, k, work)
        now[k] = t if t - now[k] <= SPAN else now[k] + SPAN


@kernel
def draw_path(size, random, table, gap, truth, law, root, work):
    """``truth[0]`` after a gap of at most SPAN."""
    n = len(size)
    laws(table, gap, len(law), law)
    for i in range(n):
        for j in range(i + 1):
            s = law[n * n + i * (i + 1) // 2 + j]
            for c in range(j):
                s -= root[i, c] * root[j, c]
            if i == j:
                root[i, i] = np.sqrt(max(s, 0.0))
            else:
                root[i, j] = s / root[j, j] if root[j, j] > 0.0 else 0.0
    for i in range(n):
        s = 0.0
        for j in range(n):
            s += law[i * n + j] * truth[0, j]
        work[0, i] = s
    for j in range(n):
        z = random.standard_normal()
        for i in range(j, n):
            work[0, i] += root[i, j] * z
    for i in range(n):
        truth[0, i] = work[0, i]


@kernel
def intersect(size, epsilon, k, other, m, S):
    """Entry k, with the weight ``epsilon`` for the information of entry ``other``, overwritten."""
    n = len(size)
    invert(size, S, k)
    invert(size, S, other)
    for i in range(n):
        for j in range(n):
            S[other, i, j] *= epsilon
            S[k, i, j] = (1.0 - epsilon) * S[k, i, j] + S[other, i, j]
    for i in range(n):
        m[other, i] -= m[k, i]
    invert(size, S, k)
    for i in range(n):
        s = 0.0
        for j in range(n):
            g = 0.0
            for c in range(n):
                g += S[k, i, c] * S[other, c, j]
            s += g * m[other, j]
        m[k, i] += s


@kernel
def fade(size, back, total, k, gap, law, work):
    """Make entry k of ``total`` (K, 1 + n (n + 1) / 2 + n), a weight, the lower triangle of an
    information U and U x, refer to x after a gap: U <- M' U M and U x <- e^(-r gap) M' U x;
    ``back`` has the laws of M = e^(-r gap) e^(-A gap) and, after them, of e^(-r gap).
    """
    n = len(size)
    first = 1 + n * (n + 1) // 2
    while gap > 0.0:
        laws(back, min(gap, SPAN), len(law), law)
        for i in range(n):
            for j in range(n):
                s = 0.0
                for c in range(n):
                    a, b = max(i, c), min(i, c)
                    s += total[k, 1 + a * (a + 1) // 2 + b] * law[c * n + j]
                work[i, j] = s
            work[n, i] = total[k, first + i]
        for i in range(n):
            for j in range(i + 1):
                s = 0.0
                for c in range(n):
                    s += law[c * n + i] * work[c, j]
                total[k, 1 + i * (i + 1) // 2 + j] = s
            s = 0.0
            for c in range(n):
                s += law[c * n + i] * work[n, c]
            total[k, first + i] = law[n * n] * s
        gap -= SPAN


@kernel
def offer(size, e, degree, m, S, weight, sent, work):
    """Node e adds a share for each of its receivers to what it ever sent; ``work`` (n + 1, n)."""
    n, N = len(size), len(weight)
    share = weight[e] / (degree + 1)
    weight[e] -= degree * share
    sent[e, 0] += share
    for i in range(n):
        for j in range(n):
            work[i, j] = S[e, i, j]
    S0 = work.reshape((1, n + 1, n))
    invert(size, S0, 0)
    for i in range(n):
        s = 0.0
        for j in range(n):
            s += work[i, j] * m[e, j]
        sent[e, 1 + n * (n + 1) // 2 + i] += share / N * s
        for j in range(i + 1):
            sent[e, 1 + i * (i + 1) // 2 + j] += share / N * work[i, j]


@kernel
def gain(size, k, link, slot, m, S, weight, heard, total, line):
    """Node k gains what the total of a message has more than the last one heard on its link."""
    n, N = len(size), len(weight)
    invert_entry(size, k, m, S, line)
    more = total[slot, 0] - heard[link, 0]
    own, share = weight[k] / (weight[k] + more), N / (weight[k] + more)
    weight[k] += more
    for i in range(n):
        e = 1 + n * (n + 1) // 2 + i
        m[k, i] = own * m[k, i] + share * (total[slot, e] - heard[link, e])
        for j in range(i + 1):
            e = 1 + i * (i + 1) // 2 + j
            S[k, i, j] = own * S[k, i, j] + share * (total[slot, e] - heard[link, e])
            S[k, j, i] = S[k, i, j]
    for e in range(total.shape[1]):
        heard[link, e] = total[slot, e]
    invert_entry(size, k, m, S, line)


@kernel
def broadcasts(
    size, random, times, table, back, start, sensors, sampling, clock, links, loss, delay, rule,
    epsilon, x, xhat, P,
):  # fmt: skip
    """Nodes broadcast at ticks of their clocks, and intersect with what arrives, or gain it.

    ``times`` (T,) of probes; ``table`` of laws F, Q and ``back`` of ``fade``; ``start`` mean,
    covariance and its root; ``sensors`` H (S, 1, n), of variance 1, and their nodes (S,);
    ``sampling`` and ``clock`` of ``tick_after``; ``links``: offsets (N + 1,) and receivers (L,);
    ``loss`` of ``arrives``; ``delay``: uniform from its first to its second value, or exponential
    with its third as mean. Returns the number of ticks, samples and messages sent.
    """
    n, (runs, _, N, _) = len(size), xhat.shape
    (H, owners), (first, receivers) = sensors, links
    L, room, length = len(receivers), 64 * N, 1 + n * (n + 1) // 2 + n
    m, S = np.empty((N + room, n)), np.empty((N + room, n, n))
    now, over, free = np.empty(N + room), np.empty(room, np.int64), np.empty(room, np.int64)
    entities = N + len(owners)
    heap, owner = np.empty(entities + room), np.empty(entities + room, np.int64)
    phase, number, bad = np.empty(entities), np.empty(entities, np.int64), np.empty(L, np.int64)
    law, work = np.empty(table.shape[2]), np.empty((n + 1, n))
    fading, scaled = np.empty(back.shape[2]), np.empty((1, 1, n))
    root, line, truth, events = np.zeros((n, n)), np.empty(n), np.empty((1, n)), 0
    total, weight = np.empty((room, length)), np.empty(N)
    sent, sent_at, rounds = np.empty((N, length)), np.empty(N), np.empty(N, np.int64)
    heard, heard_at, newest = np.empty((L, length)), np.empty(L), np.empty(L, np.int64)
    numbered = np.empty(room, np.int64)
    for r in range(runs):
        draw_state(size, random, start[0], start[2], truth[0])
        start_filters(start[0], start[1], m[:N], S[:N])
        start_chains(random, loss, bad)
        weight[:], sent[:], sent_at[:], rounds[:] = 1.0, 0.0, 0.0, 0
        heard[:], heard_at[:], newest[:] = 0.0, 0.0, 0
        now[:N], last, spare, count = 0.0, 0.0, room, entities
        for k in range(room):
            free[k] = k
        for e in range(entities):
            start_clock(random, clock if e < N else sampling, e, phase, number, heap, owner)
        for probe in range(len(times)):
            while heap[0] <= times[probe]:
                t, e, events = heap[0], owner[0], events + 1
                if e < entities:
                    heap[0] = tick_after(random, clock if e < N else sampling, e, t, phase, number)
                else:
                    count -= 1
                    heap[0], owner[0] = heap[count], owner[count]
                sink(heap, owner, count)
                if e < N:
                    move_to(size, table, t, e, now, m, S, law, work)
                    if rule == SUMS:
                        fade(size, back, sent, e, t - sent_at[e], fading, work)
                        offer(size, e, first[e + 1] - first[e], m, S, weight, sent, work)
                        sent_at[e] = t
                        rounds[e] += 1
                    for k in range(first[e], first[e + 1]):
                        events += 1
                        if arrives(random, random.random(), loss, bad, k):
                            spare -= 1
                            slot = free[spare]
                            over[slot], own = k, N + slot
                            now[own] = t
                            if rule == SUMS:
                                numbered[slot] = rounds[e]
                                for i in range(length):
                                    total[slot, i] = sent[e, i]
                            else:
                                for i in range(n):
                                    m[own, i] = m[e, i]
                                    for j in range(n):
                                        S[own, i, j] = S[e, i, j]
                            if delay[2] > 0.0:
                                arrival = t + delay[2] * random.standard_exponential()
                            else:
                                arrival = t + delay[0] + (delay[1] - delay[0]) * random.random()
                            heap[count], owner[count] = arrival, entities + slot
                            count += 1
                            sift(heap, owner, count - 1)
                elif e < entities:
                    draw_path(size, random, table, t - last, truth, law, root, work)
                    last, k = t, owners[e - N]
                    y = read(size, random, H, e - N, 0, truth[0])
                    move_to(size, table, t, k, now, m, S, law, work)
                    if rule == SUMS:
                        scale = np.sqrt(N / weight[k])
                        for i in range(n):
                            scaled[0, 0, i] = scale * H[e - N, 0, i]
                        update(size, scale * y, scaled, 0, 0, m, S, k, line)
                    else:
                        update(size, y, H, e - N, 0, m, S, k, line)
                else:
                    slot = e - entities
                    link, own = over[slot], N + slot
                    k = receivers[link]
                    if rule != SUMS:
                        move_to(size, table, t, own, now, m, S, law, work)
                        move_to(size, table, t, k, now, m, S, law, work)
                        intersect(size, epsilon, k, own, m, S)
                    elif numbered[slot] > newest[link]:
                        newest[link] = numbered[slot]
                        move_to(size, table, t, k, now, m, S, law, work)
                        fade(size, back, total, slot, t - now[own], fading, work)
                        fade(size, back, heard, link, t - heard_at[link], fading, work)
                        heard_at[link] = t
                        gain(size, k, link, slot, m, S, weight, heard, total, line)
                    free[spare] = slot
                    spare += 1
            if times[probe] > last:
                draw_path(size, random, table, times[probe] - last, truth, law, root, work)
                last = times[probe]
            for k in range(N):
                move_to(size, table, times[probe], k, now, m, S, law, work)
            keep(size, truth[0], m[:N], S[:N], r, probe, x, xhat, P)
    return events
