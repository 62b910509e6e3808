"""What an engineer would write with SciPy in place of `casadi-engine fit`: read, fit, errors, figures, a page.

    python tests/benchmarks/peer_page.py RECORD.csv.gz FOLDER

Two masses in the linear form; the fit is the strongest one known to us (`opponent_two_mass`), with its covariance; the
page shows the values with their errors, the trace, a part of it, the residual's autocorrelation and spectrum.
"""

import base64
import html
import io
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import opponent_two_mass
import two_mass_data
from scipy.signal import lsim, welch

START = {"J_eng": 0.5, "J_load": 0.2, "K_el": 1500.0, "C_el": 3.0, "C_eng": 0.2}


def simulated(values, first, record):
    """Speed of the crank over the record."""
    j1, j2, k, c, c1 = (values[name] for name in two_mass_data.NAMES)
    a = [[-(c + c1) / j1, c / j1, k / j1], [c / j2, -c / j2, -k / j2], [-1.0, 1.0, 0.0]]
    b = [[1 / j1, 0.0], [0.0, -1 / j2], [0.0, 0.0]]
    system = (a, b, [[1.0, 0.0, 0.0]], [[0.0, 0.0]])
    drives = np.column_stack([record.torque_eng, record.torque_load])
    return lsim(system, drives, record.step * np.arange(record.y.size), first)[1]


def figure(time, speed, fitted):
    """The page's figures as one PNG, in base64."""
    left = speed - fitted
    made, axes = plt.subplots(2, 2, figsize=(11, 6))
    axes[0, 0].plot(time, speed, time, fitted, linewidth=0.8)
    part = slice(0, len(time) // 10)
    axes[0, 1].plot(time[part], speed[part], ".", time[part], fitted[part], linewidth=0.8)
    spectrum = np.fft.rfft(left, 2 * left.size)
    axes[1, 0].stem(np.fft.irfft(abs(spectrum) ** 2)[:40] / (left @ left))
    axes[1, 1].semilogy(*welch(left, 1 / (time[1] - time[0]), nperseg=2048))
    held = io.BytesIO()
    made.savefig(held, format="png", dpi=100)
    return base64.b64encode(held.getvalue()).decode()


def main():
    record = two_mass_data.read_record(sys.argv[1])
    found = opponent_two_mass.fit(record.y, record.torque_eng, record.torque_load, record.step, START)
    values, errors = found["parameters"], np.sqrt(np.diag(found["covariance"]))
    fitted = simulated(values, found["initial_state"], record)
    rows = "".join(
        f"<tr><td>{html.escape(name)}<td>{value:.6g}<td>{error:.2g}"
        for (name, value), error in zip(values.items(), errors, strict=True)
    )
    picture = figure(record.t, record.y, fitted)
    page = f"<h1>Two masses</h1><table>{rows}</table><img src='data:image/png;base64,{picture}'>"
    folder = Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.html").write_text(page)
    print(values, errors, np.std(record.y - fitted))


if __name__ == "__main__":
    main()
