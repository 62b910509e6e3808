"""The JAK2/STAT5 model of Bachmann et al., Mol. Syst. Biol. 7 (2011), 516: 25 states, 27 parameters, 14 outputs.

Feedback by CIS and SOCS3 on the receptor; the mRNAs pass through chains of five compartments. Its three initial
amounts are parameters that scale rates and outputs.

Two parameters are lost: the amount of receptor, of which only shares are measured, and EpoRCISInh, which stands
beside an unmeasured amount of inhibitor. The rank is 49 of 52, not the 50 that comparisons of tools quote: p1 and p12
enter everything but themselves as their sum, so a shift between them is a third direction that leaves no trace.
"""

from __future__ import annotations

import casadi_engine as ce

PARAMETERS = [
    "CISEqc", "CISEqcOE", "CISInh", "CISRNADelay", "CISRNATurn", "CISTurn", "EpoRActJAK2", "EpoRCISInh",
    "EpoRCISRemove", "JAK2ActEpo", "JAK2EpoRDeaSHP1", "SHP1ActEpoR", "SHP1Dea", "SHP1ProOE", "SOCS3Eqc",
    "SOCS3EqcOE", "SOCS3Inh", "SOCS3RNADelay", "SOCS3RNATurn", "SOCS3Turn", "STAT5ActEpoR", "STAT5ActJAK2",
    "STAT5Exp", "STAT5Imp", "init_EpoRJAK2", "init_SHP1", "init_STAT5",
]  # fmt: skip
INPUTS = ["ActD", "CISoe", "SOCS3oe", "SHP1oe", "Epo"]
CYTOPLASM, NUCLEUS = 0.4, 0.275


def jakstat2() -> ce.Model:
    b = ce.Blueprint("jakstat_2")
    p = {name: b.parameter(name, 1.0) for name in PARAMETERS}
    drug, cis_more, socs_more, shp_more, epo = (b.input(name) for name in INPUTS)
    receptor, active, p1, p2, p12, bound = (
        b.state(name) for name in ("EpoRJAK2", "EpoRpJAK2", "p1", "p2", "p12", "EpoRJAK2_CIS")
    )
    shp, shp_active = b.state("SHP1"), b.state("SHP1Act")
    stat, pstat, nuclear = b.state("STAT5"), b.state("pSTAT5"), b.state("npSTAT5")
    cis, cis_rna = b.state("CIS"), b.state("CISRNA")
    socs, socs_rna = b.state("SOCS3"), b.state("SOCS3RNA")
    held = 1 + socs * p["SOCS3Inh"] / p["SOCS3Eqc"]
    off = p["JAK2EpoRDeaSHP1"] / p["init_SHP1"] * shp_active
    on = epo * receptor * p["JAK2ActEpo"] / held
    step, slow = p["EpoRActJAK2"] / held, 3 * p["EpoRActJAK2"] / held / (1 + p["EpoRCISInh"] * bound)
    every = active + p1 + p2 + p12
    b.ode("EpoRJAK2", off * every - on)
    b.ode("EpoRpJAK2", on - active * (step + slow + off))
    b.ode("p1", active * step - p1 * (off + slow))
    b.ode("p2", active * slow - p2 * (off + step))
    b.ode("p12", p2 * step + p1 * slow - p12 * off)
    b.ode("EpoRJAK2_CIS", -bound * p["EpoRCISRemove"] / p["init_EpoRJAK2"] * (p12 + p1))
    shp_on = shp * p["SHP1ActEpoR"] / p["init_EpoRJAK2"] * every
    b.ode("SHP1", p["SHP1Dea"] * shp_active - shp_on)
    b.ode("SHP1Act", shp_on - p["SHP1Dea"] * shp_active)
    by_jak = stat * p["STAT5ActJAK2"] / p["init_EpoRJAK2"] * every / held
    free_of_cis = 1 + cis * p["CISInh"] / p["CISEqc"]
    by_receptor = stat * p["STAT5ActEpoR"] / p["init_EpoRJAK2"] ** 2 * (p12 + p1) ** 2 / free_of_cis / held
    b.ode("STAT5", p["STAT5Exp"] * nuclear * NUCLEUS / CYTOPLASM - by_jak - by_receptor)
    b.ode("pSTAT5", by_jak + by_receptor - p["STAT5Imp"] * pstat)
    b.ode("npSTAT5", p["STAT5Imp"] * pstat * CYTOPLASM / NUCLEUS - p["STAT5Exp"] * nuclear)
    for gene, protein, rna, more in (("CIS", cis, cis_rna, cis_more), ("SOCS3", socs, socs_rna, socs_more)):
        delay, turn = p[f"{gene}RNADelay"], p[f"{gene}RNATurn"]
        flow = turn / p["init_STAT5"] * nuclear * (1 - drug)
        for k in range(1, 6):
            link = b.state(f"{gene}nRNA{k}")
            b.ode(f"{gene}nRNA{k}", flow - delay * link)
            flow = delay * link
        b.ode(f"{gene}RNA", flow * NUCLEUS / CYTOPLASM - turn * rna)
        scale = p[f"{gene}Eqc"]
        b.ode(gene, p[f"{gene}Turn"] * (rna * scale - protein + more * p[f"{gene}EqcOE"] * scale))
    outputs = (
        2 * every / p["init_EpoRJAK2"],
        16 * (p1 + p2 + p12) / p["init_EpoRJAK2"],
        socs / p["SOCS3Eqc"],
        (stat + pstat) / p["init_STAT5"],
        pstat / p["init_STAT5"],
        stat,
        shp + shp_active,
        cis,
        socs,
        100 * pstat / (pstat + stat),
        socs_rna,
        cis_rna,
        (shp + shp_active) / p["init_SHP1"] * (1 + shp_more * p["SHP1ProOE"]),
        cis / p["CISEqc"],
    )
    for number, output in enumerate(outputs, start=1):
        b.output(f"y{number}", output)
    return b.model()
