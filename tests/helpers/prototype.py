"""The authors' layout of recordings, made up."""

import numpy as np

JOINTS = ("joint1", "joint2", "joint3")


def write_prototype(folder, experiments, rows=200):
    """Files in the authors' layout; motor M is polled 2 ms after motor M − 1 and follows sines in degrees."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in experiments:
        for motor in (1, 2, 3):
            t = 0.006 * np.arange(rows) + 0.002 * motor
            q, dq = 20 * motor * np.sin(3 * t), 60 * motor * np.cos(3 * t)
            columns = [t, q, dq, 0 * t, 0 * t, motor * t, 0 * t]
            text = "".join(" ".join(f"{x:.6f}" for x in row) + "\r\n" for row in zip(*columns, strict=True))
            (folder / f"data_file_{motor}_Exp{number}.txt").write_text(text, newline="")
    return folder
