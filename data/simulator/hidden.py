"""Hidden effects: what a plant has and a model lacks, as sharp as it is in nature."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from .shaft import Shaft

# Where each effect may sit: on an inertia, in a coupling, in a cylinder, at a sensor.
PLACES: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("inertia", "coupling"),
    "viscous_friction": ("inertia", "coupling"),
    "quadratic_drag": ("inertia",),
    "stribeck_friction": ("inertia",),
    "constant_torque": ("inertia",),
    "cubic_stiffness": ("coupling",),
    "backlash": ("coupling",),
    "misfire": ("cylinder",),
    "cylinder_imbalance": ("cylinder",),
    "load_step": ("inertia",),
    "sensor_offset": ("sensor",),
    "sensor_delay": ("sensor",),
}
# What an effect needs besides its size.
DETAILS: Mapping[str, tuple[str, ...]] = {
    "stribeck_friction": ("fading",),
    "misfire": ("cycles",),
    "load_step": ("time",),
}


@dataclass(frozen=True)
class Hidden:
    """An effect, its place and its size.

    coulomb_friction   size [N m] against the motion; sticks at rest as long as it can hold
    viscous_friction   size [N m s/rad] against the motion
    quadratic_drag     size [N m s2/rad2] against the motion, with speed squared
    stribeck_friction  size exp(-(speed/fading)^2) [N m] against the motion, `fading` [rad/s]; sticks
    constant_torque    size [N m], positive accelerates
    cubic_stiffness    size * twist^3 [N m/rad3] beside the spring
    backlash           play of +-size [rad]: the spring acts on the twist less the play; the damper stays
    misfire            share `size` of the burn strength is lost in `cycles` (1, 2, ...)
    cylinder_imbalance share `size` of the burn strength is added in all cycles, also before the record
    load_step          size [N m] more braking from `time` [s] on
    sensor_offset      size [rad/s] is added to what the sensor shows
    sensor_delay       the sensor shows what was `size` [s] before
    Recorded pressures tell nothing of misfire_ and imbalance: they are those of the engine without.

    at: "engine", "load", "coupling" or "inertia_3", "coupling_76"; "cylinder_2"; "sensor_omega", "sensor_omega_load"
    """

    name: str
    at: str
    size: float
    details: Mapping[str, float | Sequence[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name not in PLACES:
            raise ValueError(f"unknown effect {self.name!r}; there are {', '.join(PLACES)}")
        wanted = DETAILS.get(self.name, ())
        if set(self.details) != set(wanted):
            raise ValueError(f"{self.name} needs the details {wanted}, not {tuple(self.details)}")


def hidden(name: str, at: str, size: float, **details: float | Sequence[int]) -> Hidden:
    """The effect `name` at the port `at`; see `Hidden`."""
    return Hidden(name, at, float(size), details)


def place(effect: Hidden, shaft: Shaft) -> tuple[str, int]:
    """Kind and number (from 0) of the place of an effect on a shaft."""
    names = {"sensor_omega": ("sensor", 0), "sensor_omega_load": ("sensor", 1)}
    names |= {f"cylinder_{c + 1}": ("cylinder", c) for c in range(4)}
    if shaft.size == 2:
        names |= {"engine": ("inertia", 0), "load": ("inertia", 1), "coupling": ("coupling", 0)}
    else:
        names |= {f"inertia_{i + 1}": ("inertia", i) for i in range(shaft.size)}
        names |= {f"coupling_{i + 2}{i + 1}": ("coupling", i) for i in range(shaft.size - 1)}
    right = [name for name, (kind, _) in names.items() if kind in PLACES[effect.name]]
    if effect.at not in right:
        raise ValueError(f"{effect.name} cannot be at {effect.at!r}; places are {', '.join(right)}")
    return names[effect.at]
