"""Covariances of the errors of all coupled Kalman-Bucy filters, integrated along one run.

Between messages every node has the covariance P_i and the error e_i = x - xhat_i with

    dP_i/dt = A P_i + P_i A' + Q - P_i G_i P_i,
    d cov(e_i, e_j)/dt = K_i cov + cov K_j' + Qt + (P_i Gt_i P_i where i = j),   K_i = A - P_i G_i,

where G_i = H_i' R_i^-1 H_i is the information per second that the filter assumes, and Gt_i = H_i'
R_i^-1 Rt_i R_i^-1 H_i that of the true noise Rt_i through the same gain; Qt is the true Q. At an
instant of messages both are mixed with the weights of paper H (7), (9) (Tanwani 2021). The
integrator is the classical Runge-Kutta method of order 4, with steps short against all rates, so
that its error is far below what averages over runs need: ``theory.hybrid.path_moments`` has from it
the mean squared errors of a run, given the times of its messages. Indices i, j are nodes; a, b, c,
d are states.
"""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel


@kernel
def covariance_slope(
    P: FloatArray, A: FloatArray, Q: FloatArray, G: FloatArray, K: FloatArray, dP: FloatArray
) -> None:
    """Write ``K`` and ``dP`` (N, n, n): K_i = A - P_i G_i and dP_i/dt = K_i P_i + P_i A' + Q for
    all N nodes, from their covariances P (N, n, n) and information rates G (N, n, n), 1/s; A and Q
    are (n, n).
    """
    N, n = len(P), len(A)
    for i in range(N):
        for a in range(n):
            for b in range(n):
                total = A[a, b]
                for c in range(n):
                    total -= P[i, a, c] * G[i, c, b]
                K[i, a, b] = total
        # dP = K P + P A' + Q, since K P = A P - P G P.
        for a in range(n):
            for b in range(n):
                total = Q[a, b]
                for c in range(n):
                    total += K[i, a, c] * P[i, c, b] + P[i, a, c] * A[b, c]
                dP[i, a, b] = total


@kernel
def error_slope(S: FloatArray, K: FloatArray, true_Q: FloatArray, dS: FloatArray) -> None:
    """Write dS_ij/dt = K_i S_ij + S_ij K_j' + Qt into ``dS`` (N, N, n, n) for the covariances S
    (N, N, n, n) of the errors of N nodes, S_ij = cov(e_i, e_j), without the noise of the sensors. K
    (N, n, n) are the closed loops A - P_i G_i; Qt = ``true_Q`` (n, n) is the noise of the plant.
    """
    # All errors share the noise of the plant. S_ji = S_ij' is filled from the same entry.
    N, n = len(S), len(true_Q)
    for i in range(N):
        for j in range(i + 1):
            for a in range(n):
                for b in range(n):
                    total = true_Q[a, b]
                    for c in range(n):
                        total += K[i, a, c] * S[i, j, c, b] + S[i, j, a, c] * K[j, b, c]
                    dS[i, j, a, b] = total
                    dS[j, i, b, a] = total


@kernel
def add_sensor_noise(P: FloatArray, true_G: FloatArray, dS: FloatArray) -> None:
    """Add P_i Gt_i P_i, the noise of the sensors, to the derivatives dS_ii/dt in ``dS``
    (N, N, n, n), in place, with Gt = ``true_G`` (N, n, n) and the filters' covariances P (N, n, n).

    Axes: N nodes.
    """
    # Only in dS_ii: the noises of different nodes are independent.
    for i in range(len(P)):
        n = P.shape[1]
        for a in range(n):
            for b in range(n):
                total = 0.0
                for c in range(n):
                    for d in range(n):
                        total += P[i, a, c] * true_G[i, c, d] * P[i, d, b]
                dS[i, i, a, b] += total


@kernel(allocates=True)
def mix(
    P: FloatArray,
    S: FloatArray,
    rows: np.ndarray,
    columns: np.ndarray,
    weights: FloatArray,
    P0: FloatArray,
    S0: FloatArray,
) -> None:
    """Apply the M messages of one instant, paper H (7) and (9), in place to the covariances P
    (N, n, n) of the filters and those of their true errors, S_ij = cov(e_i, e_j) (N, N, n, n).

    Message k moves node ``rows[k]`` by ``weights[k]`` towards node ``columns[k]``, (M,) each, all
    from the values before the instant. P0 and S0 are scratch, shaped like P and S. Axes: N nodes.
    """
    P0[:] = P
    S0[:] = S
    for k in range(len(rows)):
        i, j, w = rows[k], columns[k], weights[k]
        P[i] += w * (P0[j] - P0[i])
        S[i] += w * (S0[j] - S0[i])
    # S <- M S M' for the mixing matrix M: the rows are done, the columns follow in the same way.
    S0[:] = S
    for k in range(len(rows)):
        i, j, w = rows[k], columns[k], weights[k]
        S[:, i] += w * (S0[:, j] - S0[:, i])


@kernel(allocates=True)
def run_moments(
    P: FloatArray,
    S: FloatArray,
    model: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    instants: FloatArray,
    ends: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    weights: FloatArray,
    times: FloatArray,
    step: float,
    traces: FloatArray,
) -> None:
    """Integrate P (N, n, n) and S (N, N, n, n) of N nodes in place and write the ``traces`` (T, N)
    of cov(e_i) at ``times`` (T,), after the messages of the same instant, with steps of at most
    ``step`` seconds.

    P_i is the covariance that filter i believes, S_ij = cov(e_i, e_j) that of the true errors.
    ``model`` is (A, Q, Qt, G, Gt), (n, n) or, for G and Gt, (N, n, n). The messages at
    ``instants[m]``, seconds (M,), are those with numbers ``ends[m]`` to ``ends[m + 1]`` - 1;
    message k goes from node ``columns[k]`` to ``rows[k]`` with ``weights[k]``.
    """
    A, Q, true_Q, G, true_G = model
    K, P0, S0 = np.empty_like(P), np.empty_like(P), np.empty_like(S)
    dP, dS = np.empty((4, *P.shape)), np.empty((4, *S.shape))
    now, m, t = 0.0, 0, 0
    # From event to event: the next messages, or the next of ``times``, messages first. A gap of 0
    # takes no step.
    while t < len(times):
        until = times[t]
        if m < len(instants) and instants[m] <= until:
            until = instants[m]
        count = int(np.ceil((until - now) / step))
        for _ in range(count):
            h = (until - now) / count
            P0[:] = P
            S0[:] = S
            # Runge-Kutta of order 4: the slopes at 0, h / 2 (twice) and h, weighted 1, 2, 2, 1.
            for s in range(4):
                if s > 0:
                    share = h if s == 3 else 0.5 * h
                    P0[:] = P + share * dP[s - 1]
                    S0[:] = S + share * dS[s - 1]
                covariance_slope(P0, A, Q, G, K, dP[s])
                error_slope(S0, K, true_Q, dS[s])
                add_sensor_noise(P0, true_G, dS[s])
            P += h / 6.0 * (dP[0] + 2.0 * dP[1] + 2.0 * dP[2] + dP[3])
            S += h / 6.0 * (dS[0] + 2.0 * dS[1] + 2.0 * dS[2] + dS[3])
        now = until
        if m < len(instants) and instants[m] == until:
            first, last = ends[m], ends[m + 1]
            mix(P, S, rows[first:last], columns[first:last], weights[first:last], P0, S0)
            m += 1
        else:
            for i in range(len(P)):
                traces[t, i] = np.trace(S[i, i])
            t += 1
