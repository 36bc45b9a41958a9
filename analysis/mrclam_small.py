"""Makes scenarios/data/mrclam_small: half a minute of five simulated robots among 15 landmarks.

    python analysis/mrclam_small.py [FOLDER]

The files are those of the UTIAS MR.CLAM sets, with what their logs have too: stamps that repeat or
go back, a second without odometry, a barcode that nobody has. Then
``netkf import scenarios/data/mrclam_small --kind mrclam --out FOLDER`` makes the scenario of them.
"""

import math
import sys
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parents[1] / "scenarios" / "data" / "mrclam_small"
ORIGIN, SECONDS, STEP = 1248272270.0, 32.0, 0.01
DRIFT = (0.05, 0.05, 0.05)  # of x, y and heading after a second, metres and radians
RANGE, BEARING = 0.1, 0.03  # standard deviations of readings
FAR, WIDE = 4.5, 1.0  # what a camera sees: metres, radians to each side
BARCODES = (5, 14, 41, 32, 23, 72, 27, 54, 70, 36, 18, 25, 9, 81, 16, 90, 61, 45, 7, 63)
TITLE = "# A simulated set in the format of the UTIAS multi-robot data sets\n"


def drive(random):
    """Times, commands (K, 2) and true poses (K + 1, 3) of a robot that goes from place to place."""
    count = round(SECONDS / STEP)
    pose = np.array([*random.uniform(-3.0, 3.0, 2), random.uniform(-math.pi, math.pi)])
    poses, commands, goal, command = [pose], [], pose[:2], (0.0, 0.0)
    for k in range(count):
        if k % 50 == 0:
            while math.dist(goal, pose[:2]) < 1.0:
                goal = random.uniform(-3.5, 3.5, 2)
            ahead = math.atan2(goal[1] - pose[1], goal[0] - pose[0]) - pose[2]
            ahead = (ahead + math.pi) % (2.0 * math.pi) - math.pi
            turn = round(min(max(ahead, -0.6), 0.6), 3)
            command = (round(0.4 * math.cos(turn), 3), turn)
        v, w = command
        slip = random.standard_normal(3) * DRIFT * math.sqrt(STEP)
        pose = pose + STEP * np.array([v * math.cos(pose[2]), v * math.sin(pose[2]), w]) + slip
        poses.append(pose)
        commands.append(command)
    return STEP * np.arange(count + 1), np.array(commands), np.array(poses)


def look(random, own, others):
    """What a robot at the pose ``own`` reads of the points ``others`` by subject."""
    for subject, point in others.items():
        d = point[0] - own[0], point[1] - own[1]
        angle = (math.atan2(d[1], d[0]) - own[2] + math.pi) % (2.0 * math.pi) - math.pi
        if math.hypot(*d) < FAR and abs(angle) < WIDE:
            noise = random.standard_normal(2) * (RANGE, BEARING)
            yield BARCODES[subject - 1], math.hypot(*d) + noise[0], angle + noise[1]


def write(folder, name, columns, rows):
    lines = [" \t ".join(row) + "\n" for row in rows]
    (folder / f"{name}.dat").write_text(TITLE + f"# {columns}\n" + "".join(lines))


def make(folder=FOLDER, seed=6):
    """Write all files into ``folder``."""
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    ring = 2.0 * math.pi * np.arange(15) / 15
    points = np.stack([4.2 * np.cos(ring), 4.2 * np.sin(ring)], axis=1)
    points += random.uniform(-0.8, 0.4, (15, 2))
    marks = dict(zip(range(6, 21), np.round(points, 4), strict=True))
    numbered = [[f"{subject:3d}", f"{code:4d}"] for subject, code in enumerate(BARCODES, 1)]
    write(folder, "Barcodes", "Subject #    Barcode #", numbered)
    rows = [[f"{k:3d}", *(f"{v:.8f}" for v in (*p, 1e-4, 2e-4))] for k, p in marks.items()]
    columns = "Subject #    x [m]    y [m]    x std-dev [m]    y std-dev [m]"
    write(folder, "Landmark_Groundtruth", columns, rows)
    drives = {robot: drive(random) for robot in range(1, 6)}
    for robot, (times, commands, poses) in drives.items():
        stamps = [f"{ORIGIN + t:.3f}" for t in times]
        late = random.integers(0, 20)
        shown = poses.copy()
        shown[:, 2] = (shown[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
        truth = [[stamps[k], *(f"{v:.8f}" for v in shown[k])] for k in range(late, len(times), 20)]
        columns = "Time [s]    x [m]    y [m]    orientation [rad]"
        write(folder, f"Robot{robot}_Groundtruth", columns, truth)
        odometry = [
            [stamps[k], *(f"{u:.3f}" for u in commands[k])] for k in range(0, len(commands), 10)
        ]
        readings = []
        for k in range(50 + 7 * robot, len(times), 70):
            others = {i: one[2][k] for i, one in drives.items() if i != robot} | marks
            readings += [
                [stamps[k], f"{code:4d}", f"{r:.3f}", f"{b:.3f}"]
                for code, r, b in look(random, poses[k], others)
            ]
        if robot == 2:
            odometry.insert(40, odometry[40])
            readings[4:4] = [[readings[4][0], "  34", "2.000", "0.100"]]
        if robot == 3:
            odometry[80:82] = odometry[81], odometry[80]
            del odometry[200:209]
        write(
            folder,
            f"Robot{robot}_Odometry",
            "Time [s]    forward velocity [m/s]    angular velocity [rad/s]",
            odometry,
        )
        write(
            folder,
            f"Robot{robot}_Measurement",
            "Time [s]    Barcode #    range [m]    bearing [rad]",
            readings,
        )


if __name__ == "__main__":
    make(*map(Path, sys.argv[1:]))
