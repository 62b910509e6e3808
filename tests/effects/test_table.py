"""The library as a table: formulas read off the laws, effects of one's own, laws that fail."""

import subprocess
import sys

import pytest

import casadi_engine as ce
from casadi_engine.effects import table
from casadi_engine.effects.table import rows_of
from casadi_engine.errors import EffectError


class Bristles(ce.Effect):
    name, attaches, kin = "bristles", ("inertia",), ("coulomb_friction",)
    amplitude = ce.effects.Amplitude("stiffness", unit="N m/rad", min=0)

    def law(self, port, p, math):
        bend = port.state("bend")
        slip = port.speed - math.abs(port.speed, width=0.1) * bend if port.has("speed") else 0
        gain = 2.0 if port.typical("speed") == 1.0 and not port.courses("speed") else 1.0
        return ce.effects.Law(-gain * p.stiffness * bend, {"bend": (0.0, slip + port.width(0.0))})


class Broken(ce.Effect):
    name, attaches, amplitude = "broken", ("inertia",), ce.effects.Amplitude("size")

    def law(self, port, p, math):
        return p.size * port.__wrong__


def test_every_effect_of_the_library_has_its_formula_and_what_it_reads():
    lines = table().splitlines()
    assert lines[0].split() == [
        "effect",
        "adds",
        "at",
        "its",
        "port",
        "port",
        "reads",
        "amplitude",
        "looks",
        "like",
    ]
    assert lines[-1] == "Units follow the port: N s/mm, W/K or N m s/deg for N m s/rad."
    shown = {(line.split()[0]) for line in lines[1:-1]}
    assert shown == {effect.name for effect in ce.effects.library()}
    assert not any("cannot be written" in line for line in lines)
    known = {row.effect + " " + row.port: row for effect in ce.effects.library() for row in rows_of(effect)}
    assert known["coulomb_friction coupling"].formula == "torque*sign(twist_rate)"
    assert known["backlash coupling"].signals == ("stiffness", "twist")
    assert known["backlash coupling"].formula == "dead_zone(stiffness*twist, stiffness*gap) - stiffness*twist"
    assert known["sensor_offset sensor"].amplitude == "offset [unit of its port]"
    assert "firing_offset" in known["misfire cylinder"].signals


def test_signals_of_the_table_are_those_a_port_needs():
    """A port with the listed signals takes the effect; one that lacks the last does not."""
    for effect in ce.effects.library():
        for row in rows_of(effect):
            if row.port not in ("inertia", "coupling") or not row.signals:
                continue
            for names, fits in ((row.signals, True), (row.signals[:-1], False)):
                b = ce.Blueprint("one")
                q, w = b.state("q", unit="rad"), b.state("w", unit="rad/s")
                known = {"speed": w, "twist_rate": w, "twist": q, "stiffness": b.parameter("k", 2.0)}
                slot = b.port("place", row.port, {name: known[name] for name in names})
                b.ode("q", w)
                b.ode("w", (1 if row.port == "inertia" else -1) * slot)
                b.output("y", q, unit="rad")
                found = [port.name for port in ce.effects.ports_for(b.model(), effect)]
                assert found == (["place"] if fits else []), (effect.name, names)


def test_effects_of_ones_own_are_shown_too():
    (row,) = rows_of(Bristles())
    assert row.formula == "-2*stiffness*bend; d(bend)/dt = speed - abs(speed)*bend"
    assert row.signals == ("speed",)
    assert "(cannot be written: AttributeError: __wrong__)" in table([Broken()])
    positive = type(
        "Positive", (Broken,), {"law": lambda _, port, p, math: p.size * math.positive(port.speed, 1)}
    )
    assert "size*positive(speed)" in table([positive()])
    with pytest.raises(EffectError, match="an effect is needed, not its class"):
        table([Broken])


def test_the_package_prints_it():
    done = subprocess.run(
        [sys.executable, "-m", "casadi_engine.effects"], capture_output=True, text=True, check=True
    )
    assert done.stdout.rstrip("\n") == table()
