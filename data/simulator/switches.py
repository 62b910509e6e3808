"""Torques of hidden effects on many runs at once; those with switches keep a mode that only events change.

Between events every torque is a smooth function of the state, so that an integrator of high order keeps its order.
A torque acts on an inertia, or between two neighbours: `lean` (n,) says what it does to each inertia.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .hidden import Hidden, place
from .shaft import Shaft


@dataclass
class Torque:
    """One kind of torque at one place, in the runs `runs` (a slice or index array of the batch).

    signal: number of the speed, twist rate or twist that it depends on; lean (n,): where it acts
    size, more: (runs,) numbers
    """

    kind: str
    runs: np.ndarray
    signal: int
    lean: np.ndarray
    size: np.ndarray
    more: np.ndarray
    mode: np.ndarray = field(default_factory=lambda: np.zeros(0))
    origin: int = -1  # its number in the batch that a part was taken from

    def __post_init__(self) -> None:
        # neighbouring runs are looked at without copying
        self.columns: slice | np.ndarray = self.runs
        if len(self.runs) and self.runs[-1] - self.runs[0] == len(self.runs) - 1:
            self.columns = slice(int(self.runs[0]), int(self.runs[-1]) + 1)
        self.places = [(int(i), float(self.lean[i])) for i in np.flatnonzero(self.lean)]

    def value(self, seen: np.ndarray) -> np.ndarray:
        """Torque (runs,) at what is seen (runs,), in the present modes; rubbing that sticks counts 0."""
        if self.kind == "viscous_friction":
            return -self.size * seen
        if self.kind == "quadratic_drag":
            return -self.size * self.mode * seen * seen
        if self.kind == "constant_torque":
            return self.size
        if self.kind == "cubic_stiffness":
            return self.size * seen**3
        if self.kind == "backlash":  # `more` is the stiffness
            return -self.more * np.where(self.mode == 0.0, seen, self.mode * self.size)
        if self.kind == "load_step":
            return -self.size * self.mode
        return -self.mode * self.limit(seen)  # dry friction

    def limit(self, seen: np.ndarray) -> np.ndarray:
        """Size of dry friction (runs,): constant, or fading with the speed `more`."""
        if self.kind == "stribeck_friction":
            return self.size * np.exp(-((seen / self.more) ** 2))
        return self.size

    @property
    def rubs(self) -> bool:
        return self.kind in ("coulomb_friction", "stribeck_friction")

    @property
    def switches(self) -> bool:
        return self.rubs or self.kind in ("quadratic_drag", "backlash", "load_step")

    def start(self, time: np.ndarray, seen: np.ndarray) -> None:
        """Set the modes at the first sample."""
        if self.kind == "backlash":
            self.mode = np.sign(seen) * (np.abs(seen) > self.size)
        elif self.kind == "load_step":
            self.mode = (time >= self.more).astype(float)
        else:
            self.mode = np.where(seen >= 0.0, 1.0, -1.0)

    def gap(self, time: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Event function (runs,): positive while the mode holds. Sticking is looked after elsewhere."""
        if self.kind == "load_step":
            return np.where(self.mode == 0.0, self.more - time, 1.0)
        if self.kind == "backlash":
            return np.where(self.mode == 0.0, self.size - np.abs(seen), self.mode * seen - self.size)
        return np.where(self.mode == 0.0, 1.0, self.mode * seen)

    def turn(self, which: np.ndarray, seen: np.ndarray) -> None:
        """Change the modes of the runs `which` whose event has come; dry friction is set by `Batch`."""
        if self.kind == "load_step":
            self.mode[which] = 1.0
        elif self.kind == "backlash":
            self.mode[which] = np.where(self.mode[which] == 0.0, np.sign(seen[which]), 0.0)
        else:
            self.mode[which] = -self.mode[which]


def torques_of(shaft: Shaft, cases: Sequence[Sequence[Hidden]]) -> list[Torque]:
    """The torques of the effects of each run, gathered by kind and place."""
    groups: dict[tuple[str, str], list[tuple[int, Hidden]]] = {}
    for run, effects in enumerate(cases):
        keys = [(effect.name, effect.at) for effect in effects]
        if len(set(keys)) < len(keys):
            raise ValueError(f"run {run} has an effect twice at one place")
        for key, effect in zip(keys, effects, strict=True):
            if place(effect, shaft)[0] in ("inertia", "coupling"):
                groups.setdefault(key, []).append((run, effect))
    made = []
    for (name, _), members in groups.items():
        runs = np.array([run for run, _ in members])
        kind, where = place(members[0][1], shaft)
        signal, lean = _geometry(shaft, kind, where, name)
        size = np.array([effect.size for _, effect in members])
        more = np.zeros(len(members))
        if name == "backlash":
            more[:] = shaft.stiffness[where]
        for detail in ("fading", "time"):
            if detail in members[0][1].details:
                more = np.array([float(effect.details[detail]) for _, effect in members])  # type: ignore[arg-type]
        made.append(Torque(name, runs, signal, lean, size, more, np.zeros(len(members))))
    return made


def _geometry(shaft: Shaft, kind: str, where: int, name: str) -> tuple[int, np.ndarray]:
    n = shaft.size
    lean = np.zeros(n)
    if kind == "inertia":
        lean[where] = 1.0
        return where, lean
    if name in ("cubic_stiffness", "backlash"):
        lean[where], lean[where + 1] = 1.0, -1.0  # as the spring: a positive twist pulls the near side on
        return 2 * n - 1 + where, lean
    lean[where], lean[where + 1] = -1.0, 1.0  # against a positive rate, the far side is held back
    return n + where, lean


def signal_rows(shaft: Shaft) -> np.ndarray:
    """Rows (3n - 2, 2n) that give what torques depend on: speeds (n), twist rates (n - 1), twists (n - 1)."""
    n = shaft.size
    state = np.eye(2 * n)
    speeds, twists = state[1 : 1 + n], state[1 + n :]
    return np.vstack([speeds, np.diff(speeds, axis=0), twists])
