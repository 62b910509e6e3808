"""A question about identifiability, checked and made into equations: model, parameters, experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import Any

import casadi as ca

from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability.equations import Equations, equations_of, unknown_name
from casadi_engine.identifiability.field import PRIME, WIDE_PRIME, Field, field_of
from casadi_engine.identifiability.settings import InputClass, Setting, Start, read_setting
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.parameters import compile as compile_parameters

_KEYS = ("name", "inputs", "start", "outputs")


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked: the experiments' equations and settings, and the names of everything unknown.

    equations : one for each experiment; settings : in the same order
    """

    model: Model
    parameters: Parameters
    equations: tuple[Equations, ...]
    settings: tuple[Setting, ...]

    @property
    def free(self) -> tuple[str, ...]:
        """The free parameters, ``name@experiment`` where one varies by experiment."""
        return self.equations[0].free

    @property
    def initial(self) -> tuple[str, ...]:
        """The free initial states, ``state(0)``, with ``@experiment`` if there are several."""
        several = len(self.settings) > 1
        return tuple(
            f"{state}(0)@{setting.name}" if several else f"{state}(0)"
            for setting in self.settings
            for state in setting.free_states
        )

    @property
    def special(self) -> bool:
        """True if an initial state is known: derivatives may then be silent up to some order."""
        return any(setting.special for setting in self.settings)

    @property
    def arbitrary(self) -> bool:
        """True if a drive is unknown and of no form."""
        return any(setting.arbitrary for setting in self.settings)

    @cached_property
    def field(self) -> Field:
        """The field to work in: the one in which the model's crank phases are exact rotations."""
        constants = [float(value) for one in self.equations for value in one._lifted.values]
        for prime in (PRIME, WIDE_PRIME):
            step = 2 * pi / field_of(prime).steps
            if all(
                abs(value / step - round(value / step)) * step < 1e-11
                for value in constants
                if _is_phase(value)
            ):
                return field_of(prime)
        return field_of(PRIME)

    def changed(
        self,
        *,
        parameters: Parameters | None = None,
        inputs: Mapping[str, InputClass] | None = None,
        start: Start | None = None,
        sensors: Sequence[str] = (),
    ) -> Question:
        """The question with other parameters, classes of some drives, start of all states, or further sensors."""
        equations = self.equations
        if parameters is not None:
            equations = _compiled(self.model, parameters, tuple(setting.name for setting in self.settings))
        settings = []
        for one, setting in zip(equations, self.settings, strict=True):
            known = {**setting.inputs, **(inputs or {})}
            classes = {name: known.get(name, InputClass("generic")) for name in one.driven}
            starts = setting.start if start is None else dict.fromkeys(setting.start, start)
            settings.append(Setting(setting.name, classes, starts, (*setting.outputs, *sensors)))
        return Question(self.model, parameters or self.parameters, equations, tuple(settings))


def _is_phase(value: float) -> bool:
    """True for a number that is a fraction of a turn with a small denominator."""
    step = 2 * pi / (5760 * 1001)
    return abs(value / step - round(value / step)) * step < 1e-11


def read_question(
    model: Model,
    *,
    parameters: Parameters | None = None,
    inputs: Any = "generic",
    start: Any = "free",
    outputs: Sequence[str] | None = None,
    experiments: Sequence[Mapping[str, Any]] | None = None,
) -> Question:
    """Check the words of a question; errors name what does not fit."""
    if not isinstance(model, Model):
        raise IdentifiabilityError(
            "the test needs a model",
            seen=type(model).__name__,
            allowed="a Model",
            cure="call a builder such as ce.two_mass() or Blueprint.model()",
        )
    if not (parameters is None or isinstance(parameters, Parameters)):
        raise IdentifiabilityError(
            "the parameters are not a parameter set",
            seen=type(parameters).__name__,
            allowed="a Parameters object",
            cure="start from model.parameters()",
        )
    given = (model.parameters() if parameters is None else parameters).frozen()
    asked = _experiments(experiments, {"inputs": inputs, "start": start, "outputs": outputs})
    names = tuple(one["name"] for one in asked)
    equations = _compiled(model, given, names)
    settings = tuple(read_setting(one, **words) for one, words in zip(equations, asked, strict=True))
    for one, setting in zip(equations, settings, strict=True):
        _check_outputs(one, setting)
    return Question(model, given, equations, settings)


def _experiments(experiments: Any, default: Mapping[str, Any]) -> list[dict[str, Any]]:
    if experiments is None:
        return [{"name": "", **default}]
    good = isinstance(experiments, Sequence) and not isinstance(experiments, str) and len(experiments) > 0
    if not good or not all(isinstance(one, Mapping) for one in experiments):
        raise IdentifiabilityError(
            "the experiments are not acceptable",
            seen=repr(experiments),
            allowed=f"a sequence of mappings with some of {', '.join(_KEYS)}",
            cure='write experiments=[{"inputs": "constant"}, {"inputs": "constant"}]',
        )
    made: list[dict[str, Any]] = []
    for number, one in enumerate(experiments, start=1):
        for key in one:
            if key not in _KEYS:
                raise unknown_name(
                    "an experiment has no such setting",
                    key,
                    _KEYS,
                    "what is left out is as in the call itself",
                )
        made.append({"name": str(number), **default, **one})
    names = [one["name"] for one in made]
    for name in names:
        if not isinstance(name, str):
            raise IdentifiabilityError(
                "the name of an experiment is not text",
                seen=repr(name),
                allowed='text such as "run-up", each name once',
                cure="put it in quotes, or leave it out",
            )
    if len(set(names)) < len(names):
        raise IdentifiabilityError(
            "two experiments have one name", seen=", ".join(names), allowed="each its own", cure="rename one"
        )
    return made


def _unbounded(parameters: Parameters) -> Parameters:
    """A copy without constraints and priors: inequalities and beliefs do not make a parameter identifiable."""
    made = parameters.copy()
    made._constraints.clear()
    made._frequencies.clear()
    for name in made:
        if made[name].prior is not None:
            made[name].set(prior=None)
    return made


def _compiled(model: Model, parameters: Parameters, names: tuple[str, ...]) -> tuple[Equations, ...]:
    """One for each experiment; the same object while no parameter varies by experiment."""
    records = names if len(names) > 1 else ("",)
    compiled = compile_parameters(_unbounded(parameters), model.parameter_names, records)
    made: dict[int, Equations] = {}
    for record in records:
        if id(compiled.physical[record]) not in made:
            made[id(compiled.physical[record])] = equations_of(model, compiled, record)
    return tuple(made[id(compiled.physical[record])] for record in records)


def _check_outputs(equations: Equations, setting: Setting) -> None:
    """Refuse an output that shows nothing of the system: it is most often a slip of the pen."""
    seen = ca.vertcat(equations.model.x, equations.z)
    for name in setting.outputs:
        if not ca.depends_on(equations.h[name], seen):
            text = str(equations.h[name])
            raise IdentifiabilityError(
                f"the output {name} depends on no state and no free parameter, so it tells nothing",
                seen=f"{name} = {text[:80]}",
                allowed="outputs that depend on a state or a free parameter",
                cure="look at the output's equation, or leave it out of outputs",
            )
