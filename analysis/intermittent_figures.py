"""R Figs. 1 and 2: the invariant law of the random Riccati equation.

python analysis/intermittent_figures.py --out intermittent.png
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import netkf

SCENARIOS = Path(__file__).parent.parent / "scenarios"
SCALAR = ([[2.0**0.5]], [[1.0]], [[1.0]], [[1.0]])
CELLS = ((2.41, 3.0), (5.82, 7.0), (2.41, 15.0))


def scalar_cells(axes, delivery, samples):
    """Fig. 1: the law on the cells S_0, S_1 and S_0 to S_2: exact curve and samples."""
    law = netkf.theory.scalar_law(*SCALAR, delivery)
    P = np.sort(netkf.theory.invariant_samples(*SCALAR, delivery, samples, seed=1)[:, 0, 0])
    share = np.arange(1, len(P) + 1) / len(P)
    for ax, (low, high) in zip(axes, CELLS, strict=True):
        x = np.linspace(low, high, 4000)
        ax.plot(x, law.cdf(x), color="#222222", lw=1.2, label="exact")
        ax.step(P, share, where="post", color="#c1440e", lw=0.8, label=f"{len(P):,} samples")
        ax.set(xlim=(low, high), xlabel="P", ylabel="P(P <= x)")
        inside = law.cdf([low, high])
        ax.set_ylim(inside[0] - 0.02, inside[1] + 0.02)
    axes[0].set_title(f"R Fig. 1: the law at delivery {delivery:g} on S_0", fontsize=9)
    axes[1].set_title("on S_1", fontsize=9)
    axes[2].set_title("on S_0, S_1 and S_2: flat between them", fontsize=9)
    axes[0].legend(frameon=False, fontsize=8)
    cells = [float(np.diff(law.cdf(cell))[0]) for cell in ((2.41, 3.0), (5.82, 7.0), (12.6, 15.0))]
    expected = [delivery * (1.0 - delivery) ** n for n in range(3)]
    print(
        f"mass of S_0, S_1, S_2 at g = {delivery:g}: {np.round(cells, 6)}, "
        f"g (1-g)^n = {np.round(expected, 6)}"
    )
    counted = [np.mean((low < P) & (high >= P)) for low, high in ((2.41, 3), (5.82, 7), (12.6, 15))]
    print(
        f"counted in the samples: {np.round(counted, 4)}; "
        f"mean {P.mean():.4f}, exact {law.mean():.4f}"
    )
    return cells, counted


def ten_states(axes, samples):
    """Fig. 2: distribution functions as the delivery probability goes to 1."""
    scenario = netkf.load(SCENARIOS / "intermittent_random10.toml")
    F, Q = scenario.slot_belief
    H, R = scenario.observation_matrices(0)
    star = netkf.theory.steady_covariance(F, Q, H, R)
    lower, upper = netkf.theory.critical_probability(F, H)
    print(f"ten states: critical probability in [{lower:.6f}, {upper:.6f}]")
    share = np.arange(1, samples + 1) / samples
    for delivery in (0.5, 0.6, 0.7, 0.8, 0.9, 0.95):
        P = netkf.theory.invariant_samples(F, Q, H, R, delivery, samples, seed=2)
        largest = np.linalg.eigvalsh(P)[:, -1]
        trace = np.trace(P, axis1=1, axis2=2)
        for ax, values in zip(axes, (largest, trace), strict=True):
            ax.step(np.sort(values), share, where="post", lw=1.0, label=f"{delivery:g}")
        least = np.linalg.eigvalsh(P - star).min()
        print(
            f"delivery {delivery:g}: median trace {np.median(trace):.3f}, "
            f"least eigenvalue of P - P* over all samples {least:.1e}"
        )
    for ax, value, words in zip(
        axes,
        (np.linalg.eigvalsh(star)[-1], np.trace(star)),
        ("largest eigenvalue", "trace"),
        strict=True,
    ):
        ax.axvline(value, color="#222222", ls="--", lw=1.0)
        ax.set(xscale="log", xlabel=f"{words} of P", ylabel="distribution function")
        ax.set_title(f"R Fig. 2: {words} (dashed: P*)", fontsize=9)
    axes[0].legend(frameon=False, fontsize=8, title="delivery")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("intermittent.png"))
    parser.add_argument("--samples", type=int, default=4000)
    options = parser.parse_args(arguments)
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(11, 6.5), layout="constrained")
        grid = figure.add_gridspec(2, 6)
        cells = [figure.add_subplot(grid[0, 2 * k : 2 * k + 2]) for k in range(3)]
        found = scalar_cells(cells, 0.6, options.samples)
        ten_states(
            [figure.add_subplot(grid[1, 3 * k : 3 * k + 3]) for k in range(2)], options.samples
        )
        figure.savefig(options.out, dpi=130)
    print(
        "as in the paper: mass g (1-g)^n on the cells, holes between them, P >= P*, and the laws "
        "come to P* as g goes to 1;"
    )
    print(
        "not as in the paper: no densities are drawn, since the support is a null set "
        "(a histogram would show bins, not the law)."
    )
    print(f"written to {options.out}")
    return found


if __name__ == "__main__":
    main()
