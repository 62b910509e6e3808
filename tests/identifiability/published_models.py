"""Models of other fields with published verdicts on their structural identifiability.

Ranks count free initial states and parameters together. The equations are those of the sources; where a source
lists what can be told as functions (Barreiro & Villaverde 2023, the list that Dong, Goodbrake, Harrington & Pogudin
2023 publish with their benchmarks), the parameters among them are `told` and the functions of parameters alone are
`combinations`.

Equations and several lists are those that the authors of the methods published with their code. The lists of NFkB and
of Raia's JAK-STAT, and the verdicts of the tanks, of Bertalanffy's exponent and of Goodwin's power form, were written
from memory or worked out by hand: they were not compared with the papers' pages.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi_engine as ce
from casadi_engine.parameters import parse_expression

DONG = "Dong, Goodbrake, Harrington & Pogudin, SIAM J. Appl. Algebra Geometry 7 (2023), benchmark list"
TOOLS = "Rey Barreiro & Villaverde, Bioinformatics 39 (2023), btad065"


@dataclass(frozen=True)
class Published:
    """One model and its verdict.

    odes, outputs : name -> text; inputs, parameters : names, separated by blanks
    told : the parameters that can be told; lost : those that cannot; lost_states : initial states that cannot
    rank, size : of states and parameters, None where the source gives lists alone
    combinations : text -> whether it can be told. asked : further words of the question
    """

    name: str
    source: str
    odes: dict[str, str]
    outputs: dict[str, str]
    told: str = ""
    lost: str = ""
    inputs: str = ""
    lost_states: str | None = None
    rank: int | None = None
    size: int | None = None
    combinations: dict[str, bool] = field(default_factory=dict)
    asked: dict[str, Any] = field(default_factory=dict)

    def model(self) -> ce.Model:
        return written(
            self.name, self.odes, self.outputs, parameters=f"{self.told} {self.lost}", inputs=self.inputs
        )


def written(
    name: str, odes: dict[str, str], outputs: dict[str, str], *, parameters: str, inputs: str = ""
) -> ce.Model:
    """A model from equations in text."""
    b = ce.Blueprint(name)
    names = {one: b.parameter(one, 1.0) for one in parameters.split()}
    names |= {one: b.state(one) for one in odes}
    names |= {one: b.input(one) for one in inputs.split()}
    for state, text in odes.items():
        b.ode(state, parse_expression(text, names))
    for output, text in outputs.items():
        b.output(output, parse_expression(text, names))
    return b.model()


TWO_COMPARTMENTS = Published(
    "two_compartments",
    "Bellman & Åström, Math. Biosci. 7 (1970): a compartment with a leak and a store, no input",
    {"x0": "-(a01 + a21)*x0 + a12*x1", "x1": "a21*x0 - a12*x1"},
    {"y": "x0"},
    lost="a01 a21 a12",
    lost_states="x1",
    rank=4,
    size=5,
    combinations={"a01*a12": True, "a01 + a12 + a21": True, "a01*a21": False},
)
SHAPES_OF_AN_INPUT = Published(
    "input_dependent",
    "Villaverde, Evans, Chappell & Banga, IEEE Control Syst. Lett. 3 (2019): two compartments with an unknown gain "
    "b of the input; told if the input changes, not if it is constant",
    {"x1": "-(k1e + k12)*x1 + k21*x2 + b*u", "x2": "k12*x1 - k21*x2"},
    {"y": "x1"},
    inputs="u",
    told="k1e k12 k21 b",
    lost_states="",
    rank=6,
    size=6,
)
PREDATOR = Published(
    "predator_prey",
    "Hong, Ovchinnikov, Pogudin & Yap, Comm. Pure Appl. Math. 73 (2020); the prey measured and fed",
    {"x0": "a*x0 - b*x0*x1 + u", "x1": "c*x1 + d*x0*x1"},
    {"y": "x0"},
    inputs="u",
    told="a c d",
    lost="b",
    lost_states="x1",
    rank=5,
    size=6,
)
VAJDA = Published(
    "quadratic",
    "Vajda, Godfrey & Rabitz, Math. Biosci. 93 (1989): of t2 and t3 only the product",
    {"x1": "t1*x1**2 + t2*x1*x2 + u", "x2": "t3*x1**2 + t4*x1*x2"},
    {"y": "x1"},
    inputs="u",
    told="t1 t4",
    lost="t2 t3",
    lost_states="",
    rank=3,
    size=4,
    combinations={"t2*t3": True, "t2/t3": False},
    asked={"start": {"x1": 0.0, "x2": 0.0}},
)
BOLIE = Published(
    "glucose",
    "Bolie, J. Appl. Physiol. 16 (1961); Massonis & Villaverde, Symmetry 12 (2020): insulin is not measured, so "
    "its scale, and with it p2 and p4, is free",
    {"q1": "p1*q1 - p2*q2 + u", "q2": "p3*q2 + p4*q1"},
    {"y": "q1/Vp"},
    inputs="u",
    told="p1 p3 Vp",
    lost="p2 p4",
    lost_states="q2",
    rank=6,
    size=7,
    combinations={"p2*p4": True},
)
GOODWIN = Published(
    "goodwin",
    "Goodwin, Adv. Enzyme Regul. 3 (1965), in the rational form of Hong et al. 2020 (x4 = x3**sigma)",
    {
        "x1": "-b*x1 + 1/(c + x4)",
        "x2": "alpha*x1 - beta*x2",
        "x3": "gama*x2 - delta*x3",
        "x4": "sigma*x4*(gama*x2 - delta*x3)/x3",
    },
    {"y": "x1"},
    told="b c beta delta sigma",
    lost="alpha gama",
    lost_states="x2 x3",
    rank=9,
    size=11,
    combinations={"beta + delta": True, "beta*delta": True, "alpha*gama": False},
)
GOODWIN_POWER = Published(
    "goodwin_power",
    "Goodwin 1965 as written, with the parameter sigma in the exponent: the scale of x3 is in a and A now",
    {"x1": "-b*x1 + a/(A + x3**sigma)", "x2": "alpha*x1 - beta*x2", "x3": "gama*x2 - delta*x3"},
    {"y": "x1"},
    told="b sigma beta delta",
    lost="a A alpha gama",
    lost_states="x2 x3",
    rank=9,
    size=11,
    combinations={"a/A": True, "A/(alpha*gama)**sigma": True, "alpha*gama": False},
)
BERTALANFFY = Published(
    "tumour_growth",
    "von Bertalanffy, Q. Rev. Biol. 32 (1957), a parameter in the exponent. From the size its rate is a known "
    "function of it, and N**gamma, N**gamma*log(N) and N are independent: all three can be told",
    {"N": "a*N**gamma - b*N"},
    {"y": "N"},
    told="a b gamma",
    lost_states="",
    rank=4,
    size=4,
)
SIWR = Published(
    "cholera",
    "Lee, Kelly, Ochocki, Akinwumi, Hamre, Tien & Eisenberg, J. Theor. Biol. 420 (2017); Dong et al. 2023",
    {
        "S": "mu - bi*S*I - bw*S*W - mu*S + a*R",
        "I": "bw*S*W + bi*S*I - (gam + mu)*I",
        "W": "xi*(I - W)",
        "R": "gam*I - (mu + a)*R",
    },
    {"y": "k*I"},
    told="mu bi bw a xi gam k",
    lost_states="",
    rank=11,
    size=11,
)
SIRS_FORCED = Published(
    "seasonal_epidemic",
    f"Capistrán, Moreles & Lara, Bull. Math. Biol. 71 (2009); {DONG}",
    {
        "s": "mu - mu*s - b0*(1 + b1*x1)*i*s + g*r",
        "i": "b0*(1 + b1*x1)*i*s - (nu + mu)*i",
        "r": "nu*i - (mu + g)*r",
        "x1": "-M*x2",
        "x2": "M*x1",
    },
    {"y1": "i", "y2": "r"},
    told="g mu b0 nu M",
    lost="b1",
    lost_states="x1 x2",
    rank=10,
    size=11,
)
HIV = Published(
    "hiv",
    f"Wodarz & Nowak, PNAS 96 (1999); {DONG}",
    {
        "x": "lm - d*x - beta*x*v",
        "y": "beta*x*v - a*y",
        "v": "k*y - u*v",
        "w": "c*x*y*w - c*q*y*w - b*w",
        "z": "c*q*y*w - h*z",
    },
    {"y1": "w", "y2": "z"},
    told="a u d h b",
    lost="lm beta c k q",
    lost_states="x y v",
    rank=13,
    size=15,
    combinations={"lm/q": True, "k*beta/(c*q)": True, "c*q": False, "k*lm*beta": True},
)
PK1 = Published(
    "pk1",
    f"Merkt, Timmer & Kaschek, Phys. Rev. E 92 (2015), 012920; rank 12 of 13: {TOOLS}; functions: {DONG}",
    {
        "x1": "u1 - (k1 + k2)*x1",
        "x2": "k1*x1 - (k3 + k6 + k7)*x2 + k5*x4",
        "x3": "k2*x1 + k3*x2 - k4*x3",
        "x4": "k6*x2 - k5*x4",
    },
    {"y1": "s2*x2", "y2": "s3*x3"},
    inputs="u1",
    told="k4 k5 k6",
    lost="k1 k2 k3 k7 s2 s3",
    lost_states="x2 x3 x4",
    rank=12,
    size=13,
    combinations={"s2*k1": True, "s3*k2": True, "k1 + k2": True, "k3 + k7": True, "k1/k2": False},
)
TUMOUR = Published(
    "tumour_targeting",
    "Thomas, Chapman & Langston 1989 as in Saccomani, Audoly & D'Angiò, Automatica 39 (2003): antibodies in a "
    "tumour from a known start, a, b and d known",
    {
        "x1": "-(k3 + k7)*x1 + k4*x2",
        "x2": "k3*x1 - (k4 + 0.25*k5 + 1.5*k5)*x2 + k6*(x3 + x4) + k5*x2*(x3 + x4)",
        "x3": "0.25*k5*x2 - k6*x3 - k5*x2*x3",
        "x4": "1.5*k5*x2 - k6*x4 - k5*x2*x4",
        "x5": "k7*x1",
    },
    {"y": "x5"},
    told="k3 k4 k5 k6 k7",
    lost_states="",
    rank=5,
    size=5,
    asked={"start": {"x1": 3.0, "*": "rest"}},
)
AKT = Published(
    "akt",
    f"Fujita et al., Science Signaling 3 (2010), ra56; {DONG}",
    {
        "EGFR": "T*pro_EGFR + k1b*EE - T*EGFR - k1*EE",
        "pEGFR": "k9*EE - k4*pEGFR + k2b*pA + k3*pA - k2*Akt*pEGFR",
        "pA": "k2*Akt*pEGFR - k3*pA - k2b*pA",
        "Akt": "k7*pAkt + k2b*pA - k2*Akt*pEGFR",
        "pAkt": "k5b*pS + k3*pA - k7*pAkt + k6*pS - k5*S6*pAkt",
        "S6": "k5b*pS + k8*pS6 - k5*S6*pAkt",
        "pS": "k5*S6*pAkt - k6*pS - k5b*pS",
        "pS6": "k6*pS - k8*pS6",
        "EE": "k1*EE - k9*EE - k1b*EE",
    },
    {"y1": "a1*(pEGFR + pA)", "y2": "a2*(pAkt + pS)", "y3": "a3*pS6"},
    inputs="pro_EGFR",
    told="k8 k5b k2b k3 k6 k7 k4",
    lost="k1 k1b k9 k2 k5 a1 a2 a3 T",
    combinations={"k1 - k9 - k1b": True, "k2/k5": True, "a1/k2": True, "a1/a3": True, "k1 - k1b": False},
)
CD8 = Published(
    "cd8",
    f"Crauste et al., Cell Systems 4 (2017); {DONG}",
    {
        "N": "-N*mu_N - N*P*d_NE",
        "E": "N*P*d_NE - E**2*mu_EE - E*d_EL + E*P*rho_E",
        "S": "S*d_EL - S*d_LM - S**2*mu_LL - E*S*mu_LE",
        "M": "S*d_LM - mu_M*M",
        "P": "P**2*rho_P - P*mu_P - E*P*mu_PE - S*P*mu_PL",
    },
    {"y1": "N", "y2": "E + S", "y3": "M"},
    told="mu_N mu_EE mu_LE mu_LL mu_M mu_P mu_PE mu_PL d_EL d_LM",
    lost="d_NE rho_E rho_P",
    lost_states="P",
    rank=17,
    size=18,
    combinations={"rho_E/d_NE": True, "rho_P/d_NE": True},
)
NFKB = Published(
    "nfkb",
    f"Lipniacki, Paszek, Brasier, Luxon & Kimmel, J. Theor. Biol. 228 (2004); rank 39 of 44: {TOOLS}",
    {
        "x1": "kprod - kdeg*x1 - k1*x1*u1",
        "x2": "-k3*x2 - kdeg*x2 - a2*x2*x10 + t1*x4 - a3*x2*x13 + t2*x5 + (k1*x1 - k2*x2*x8)*u1",
        "x3": "k3*x2 - kdeg*x3 + k2*x2*x8*u1",
        "x4": "a2*x2*x10 - t1*x4",
        "x5": "a3*x2*x13 - t2*x5",
        "x6": "c6a*x13 - a1*x6*x10 + t2*x5 - i1*x6",
        "x7": "i1*kv*x6 - a1*x11*x7",
        "x8": "c4*x9 - c5*x8",
        "x9": "c2 + c1*x7 - c3*x9",
        "x10": "-a2*x2*x10 - a1*x10*x6 + c4a*x12 - c5a*x10 - i1a*x10 + e1a*x11",
        "x11": "-a1*x11*x7 + i1a*kv*x10 - e1a*kv*x11",
        "x12": "c2a + c1a*x7 - c3a*x12",
        "x13": "a1*x10*x6 - c6a*x13 - a3*x2*x13 + e2a*x14",
        "x14": "a1*x11*x7 - e2a*kv*x14",
        "x15": "c2c + c1c*x7 - c3c*x15",
    },
    {"y1": "x7", "y2": "x10 + x13", "y3": "x9", "y4": "x1 + x2 + x3", "y5": "x2", "y6": "x12"},
    inputs="u1",
    told="t1 t2 c3a c4a c5 k1 k3 kprod kdeg i1 e2a i1a a1 a2 a3 c1a c2a c5a c6a c1 c2 c3 kv e1a",
    lost="k2 c4 c1c c2c c3c",
    lost_states="x8 x15",
    rank=39,
    size=44,
    combinations={"k2*c4": True, "k2/c4": False},
)
JAKSTAT1 = Published(
    "jakstat_1",
    "Raia et al., Cancer Research 71 (2011); five parameters lost: Raue, Karlsson, Saccomani, Jirstrand & Timmer, "
    "Bioinformatics 30 (2014)",
    {
        "x1": "-t1*x1*2.265*u1 - t5*x1 + t6*x2",
        "x2": "t5*x1 - t6*x2",
        "x3": "t1*2.265*u1*x1 - t2*x3*(2.8 - x6)",
        "x4": "t2*x3*(2.8 - x6) - t3*x4",
        "x5": "t3*x4 - t4*x5",
        "x6": "-t7*x3*x6/(1 + t13*x13) - t7*x4*x6/(1 + t13*x13) + t8*(2.8 - x6)*91",
        "x8": "-t9*x8*(2.8 - x6) + t10*(165 - x8)*91",
        "x10": "t11*(165 - x8)",
        "x11": "-t12*2.265*u1*x11",
        "x13": "x10*t14/(t15 + x10) - t16*x13",
    },
    {
        "y1": "x1 + x3 + x4",
        "y2": "t18*(x3 + x4 + x5 + (0.34 - x11))",
        "y3": "t19*(x4 + x5)",
        "y4": "t20*(2.8 - x6)",
        "y5": "t21*x10",
        "y6": "t22*x10*t17/t11",
        "y7": "x13",
        "y8": "165 - x8",
    },
    inputs="u1",
    told="t1 t2 t3 t4 t5 t6 t7 t8 t9 t10 t12 t13 t14 t16 t18 t19 t20",
    lost="t11 t15 t17 t21 t22",
    lost_states="",
    rank=21,
    size=23,
    combinations={"t17*t22": True, "t11*t21": True, "t15/t11": True, "t17/t22": False},
    asked={"start": {"x1": 1.3, "x2": "free", "x6": 2.8, "x8": 165.0, "x11": 0.34, "*": "rest"}},
)
ALL = (
    TWO_COMPARTMENTS, SHAPES_OF_AN_INPUT, PREDATOR, VAJDA, BOLIE, GOODWIN, GOODWIN_POWER, BERTALANFFY, SIWR,
    SIRS_FORCED, HIV, PK1, TUMOUR, AKT, CD8, NFKB, JAKSTAT1,
)  # fmt: skip
