"""The moving picture of the README: python docs/figures/moving_network.py.

The first seconds of scenarios/intel_lab.toml: 53 motes at their places in the lab, the messages of
the last 20 ms before each picture, what each mote believes, and where the target is.
"""

import argparse
import io
from pathlib import Path

import matplotlib as mpl
import numpy as np
from look import BLUE, GREY, LOOK, ORANGE, SCENARIOS
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

import netkf

END, STEP, SHUTTER = 7.0, 0.1, 0.02  # simulated seconds
COLOURS, WORST = "cividis_r", 4.0  # of motes by their error in metres


def simulate(end):
    """The run, the places (N, 2) of the motes, and the positions (T, N, 2) that they believe in."""
    scenario = netkf.load(SCENARIOS / "intel_lab.toml", {"horizon": end + STEP, "probe": STEP})
    run = netkf.simulate(scenario)
    places = np.array([scenario.topology.positions[node] for node in run.nodes])
    return scenario, run, places


def picture(scenario, run, places, k):
    """The state of the network at sample k."""
    t, events = run.times[k], run.events
    index = {node: i for i, node in enumerate(run.nodes)}
    recent = events[(events.t > t - SHUTTER) & (events.t <= t)]
    error = np.hypot(run.error[..., 0], run.error[..., 2])
    figure = Figure(figsize=(6.4, 6.6), layout="constrained")
    room, curve = figure.subplots(2, 1, height_ratios=(5, 1.1))
    for kind, colour, style, ends in (("lost", ORANGE, ":", 0.45), ("deliver", BLUE, "-", 1.0)):
        rows = recent[recent.kind == kind]
        first = places[[index[i] for i in rows.node]].reshape(-1, 2)
        second = places[[index[i] for i in rows.peer]].reshape(-1, 2)
        # A lost message ends on its way; `node` sent it. Of a delivered one `node` is the receiver.
        lines = np.stack([first, first + ends * (second - first)], axis=1)
        room.add_collection(LineCollection(lines, colors=colour, linestyles=style, lw=1.4))
    room.scatter(
        *places.T, c=error[k], cmap=COLOURS, vmin=0.0, vmax=WORST, s=46, zorder=3, lw=0.6, ec="w"
    )
    readers = places[[index[i] for i in scenario.sensing_nodes]]
    room.scatter(*readers.T, s=110, fc="none", ec="#222222", lw=1.0, zorder=3)
    room.scatter(run.xhat[k, :, 0], run.xhat[k, :, 2], s=5, color=GREY, zorder=4)
    room.scatter(run.x[k, 0], run.x[k, 2], marker="*", s=190, color="#B22222", ec="w", zorder=5)
    room.set(xlim=(-1.5, 42.5), ylim=(-0.5, 33.0), aspect="equal", xticks=[], yticks=[])
    for spine in room.spines.values():
        spine.set_visible(False)
    room.set_title(f"53 motes look for a target (star), t = {t:3.1f} s", fontsize=11)
    key = "lines: messages, dotted: lost; rings: sensors; dark: far off; grey: what motes believe"
    room.set_xlabel(key, fontsize=8)
    curve.plot(run.times[: k + 1], error[: k + 1], color=GREY, lw=0.4, alpha=0.5)
    curve.plot(run.times[: k + 1], error[: k + 1].mean(axis=1), color=BLUE, lw=1.8)
    curve.set(xlim=(0.0, END), ylim=(0.0, WORST), xlabel="time (s)", ylabel="error (m)")
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=100)
    return Image.open(buffer).convert("RGB")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path(__file__).parent.parent / "moving_network.gif"
    parser.add_argument("--out", type=Path, default=default)
    parser.add_argument("--end", type=float, default=END, help="simulated seconds")
    options = parser.parse_args(arguments)
    scenario, run, places = simulate(options.end)
    with mpl.rc_context(LOOK):
        frames = [picture(scenario, run, places, k) for k in range(len(run.times) - 1)]
    together = Image.new("RGB", (frames[0].width, 3 * frames[0].height))
    for row, frame in enumerate((frames[2], frames[len(frames) // 2], frames[-1])):
        together.paste(frame, (0, row * frame.height))
    palette = together.quantize(64, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [110] * (len(frames) - 1) + [2500]  # milliseconds
    frames[0].save(options.out, save_all=True, append_images=frames[1:], duration=durations, loop=0)
    print(f"{len(frames)} pictures, {options.out.stat().st_size / 1e6:.2f} MB in {options.out}")


if __name__ == "__main__":
    main()
