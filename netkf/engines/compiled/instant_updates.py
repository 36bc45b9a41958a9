"""Updates of the event loop with all samples of an instant, and copies of estimates."""

from __future__ import annotations

from netkf.algorithms.kernels.root_update import sample_root
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size


@kernel
def use_instant(
    state: Simulation, instant: int, root: FloatArray, x: FloatArray, k: int, scale: float
) -> None:
    """Update one estimate, entry ``k`` of K estimates ``x`` (K, n) and of the roots of P ``root``
    (K, n, n), with all samples that a node takes at an ``instant`` (index in ``state.instants``) in
    one update, stacked in the order of sensors, with noise ``scale``^2 R.
    """
    instants, scratch, n, row = state.instants, state.scratch, x.shape[1], 0
    # All sensors of the instant in one reading: R is block diagonal, and so is its root.
    for s in range(instants.first[instant], instants.first[instant + 1]):
        sensor, matrix = instants.sensor[s], instants.matrix[s]
        p = instants.rows[sensor]
        for i in range(p):
            scratch.y[row + i] = instants.y[s, i]
            for j in range(n):
                scratch.H[row + i, j] = instants.H[matrix, i, j]
            # Zeros left of the diagonal block: an earlier instant may have left entries there.
            for j in range(row):
                scratch.root_R[row + i, j] = 0.0
            for j in range(i + 1):
                scratch.root_R[row + i, row + j] = scale * instants.root[sensor, i, j]
        row += p
    # One update with all rows, as in the SimPy engine.
    if row > 0:
        sample_root(root, x, k, scratch.y[:row], scratch.H, scratch.root_R, state.update_scratch)


@kernel
def copy_state(
    size: Size,
    x: FloatArray,
    root: FloatArray,
    k: int,
    from_x: FloatArray,
    from_root: FloatArray,
    m: int,
) -> None:
    """Copy entry ``m`` of ``from_x`` (M, n) and ``from_root`` (M, n, n), lower triangular, to entry
    ``k`` of ``x`` (K, n) and ``root`` (K, n, n).
    """
    for i in range(len(size)):
        x[k, i] = from_x[m, i]
        # Only the lower triangle of a root is ever read.
        for j in range(i + 1):
            root[k, i, j] = from_root[m, i, j]
