"""Identifiability: what a model, its experiments and its data can tell about the parameters."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.identifiability.choice import Candidate, ExperimentChoice, choose_experiments
    from casadi_engine.identifiability.fisher import Information, SloppyDirection, fisher
    from casadi_engine.identifiability.operating import PlannedExperiment
    from casadi_engine.identifiability.plans import plan
    from casadi_engine.identifiability.profile import Profile, ProfileLine, profile
    from casadi_engine.identifiability.structural import Identifiability, identifiability
    from casadi_engine.identifiability.sweep import LossSweep, loss_sweep

__all__ = [
    "Candidate",
    "ExperimentChoice",
    "Identifiability",
    "Information",
    "LossSweep",
    "PlannedExperiment",
    "Profile",
    "ProfileLine",
    "SloppyDirection",
    "choose_experiments",
    "fisher",
    "identifiability",
    "loss_sweep",
    "plan",
    "profile",
]

import_at_first_use(
    __name__,
    {
        "casadi_engine.identifiability.choice": ("Candidate", "ExperimentChoice", "choose_experiments"),
        "casadi_engine.identifiability.fisher": ("Information", "SloppyDirection", "fisher"),
        "casadi_engine.identifiability.operating": ("PlannedExperiment",),
        "casadi_engine.identifiability.plans": ("plan",),
        "casadi_engine.identifiability.profile": ("Profile", "ProfileLine", "profile"),
        "casadi_engine.identifiability.structural": ("Identifiability", "identifiability"),
        "casadi_engine.identifiability.sweep": ("LossSweep", "loss_sweep"),
    },
)
