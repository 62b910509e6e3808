"""The pages of problems/thesis: each in its quick form, its conclusions and the numbers that the thesis gives.

Slow are those whose claims the tests of the rooms hold on shorter records or without any: residual tests, repair,
misfires, also those found from crank speed alone (tests/detection, tests/discrepancy/test_real_measurements.py),
reduction, engine orders, the crankshaft's modes and fit (tests/model/test_chain.py and test_crankshaft_problem.py),
experiments that are chosen (tests/identifiability), the two-mass fits from starts that are far off and with C_el free
(tests/estimation/test_two_mass_recovery.py), and pages on records that are kept beside the project.
"""

import importlib
import re
import sys
from functools import cache
from pathlib import Path

import matplotlib.image
import pytest

FOLDER = Path(__file__).parents[2] / "problems" / "thesis"
PAGES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem != "shared")


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Runs a page in its quick form, with records in a folder of their own; (place, published) -> Line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        patch.setattr(importlib.import_module("shared"), "RESULTS", tmp_path_factory.mktemp("thesis"))

        @cache
        def run(name):
            out = tmp_path_factory.mktemp(name)
            lines = importlib.import_module(name).page(True, out)
            picture = matplotlib.image.imread(out / f"{name}.png")
            assert picture.std() > 0.02  # something is drawn
            assert [line for line in lines if not line.holds] == []
            assert len({(line.place, line.published) for line in lines}) == len(lines)
            return {(line.place, line.published): line for line in lines}

        yield run
        for name in (*PAGES, "shared"):
            sys.modules.pop(name, None)


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_short_says_what_it_is_and_where_its_records_come_from(name):
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    goal = text.split('"""')[1]
    assert "simulated" in goal
    assert "not public" in goal
    assert f"python problems/thesis/{name}.py [--quick]" in goal
    imported = [
        line for line in text.splitlines() if line.startswith(("from casadi_engine", "import casadi"))
    ]
    assert imported
    for line in imported:
        assert "._" not in line
        assert line.count(".") <= 1, "names of a room come from the room, not from its files"


@pytest.mark.slow
def test_tables_4_3_to_4_5(quick):
    lines = quick("two_mass_tables")
    assert len(lines) == 10
    assert lines["4.4", "four converge with C_el fixed"].ours == "errors up to 0.14 %"
    assert lines["4.3(b) misfire", "C_el does not converge"].ours.startswith(
        "61 % off with the start known, 0.4 %"
    )


@pytest.mark.slow
def test_figures_4_11_to_4_19(quick):
    lines = quick("residual_tests")
    assert len(lines) == 7
    assert lines["Figure 4.11", "full rate: high correlation"].ours.startswith("25 of 25 lags")
    assert lines["Figure 4.13", "by 20: within the band"].ours.startswith("speed alone by 20: 0 of 25")


@pytest.mark.slow
def test_tables_4_7_to_4_13(quick):
    lines = quick("crankshaft_tables")
    assert len(lines) == 7
    assert lines["Table 4.13", "six natural frequencies"].ours == "within 0.9 Hz"
    assert lines["Table 4.13", "deformations to four digits"].ours == "within 0.0003"


@pytest.mark.slow
def test_the_reduction(quick):
    lines = quick("reduction")
    assert (
        lines["section 4.3.3", "two degrees of freedom below 300 Hz"].ours
        == "2 by the modes, of 20.5 and 335 Hz"
    )
    assert lines["section 4.3.3", "sufficient"].ours.startswith(
        "speed off by 2.9 % at 1200 RPM (one inertia: 39 %"
    )


@pytest.mark.slow
def test_tables_4_6_to_4_10(quick):
    lines = quick("engine_orders")
    assert lines["(4.11)", "natural frequencies 0.04 and 20.34 Hz"].ours == "0.04 and 20.34 Hz"
    assert lines["Table 4.10", "first order: largest/smallest 4.777"].ours.endswith("by receptance 4.776")
    assert lines["Table 4.10", "main frequency: largest/smallest 1.064"].ours == "1.053, by receptance 1.054"


@pytest.mark.slow
def test_dampers(quick):
    lines = quick("dampers")
    chosen = lines["chapter 6 (b)", "a technique is wanted: C21, C76"].ours
    assert chosen.startswith("a run-up 1000-2600 RPM in 2 s, off by C21")


def test_the_pressure_model(quick):
    lines = quick("pressure_model")
    assert lines["chapter 6 (a)", "an analytic pressure model"].ours == "simulated trace: peak -0.2 %, +0 deg"


@pytest.mark.slow
def test_the_pressure_model_on_real_traces(quick):
    """A record that lacks an edge of the wheel in each turn is a tooth off; its peak then comes right, too."""
    quick("pressure_model")
    page = sys.modules["pressure_model"]
    if not (page.TRACES / "E0NOLOAD1.npz").is_file():
        pytest.skip("the engine's records are not in ../shared/data/engine_tue")
    found = {name: (high, degrees, intake) for name, high, degrees, _, _, intake in page.real_traces()}
    assert [abs(high) < 1.5 for high, _, _ in found.values()] == [True] * 3
    assert {name: degrees for name, (_, degrees, _) in found.items()} == {
        "E0FULLOAD1": -2, "E0HALFLOAD1": 1, "E0NOLOAD1": -3,
    }  # fmt: skip
    assert [round(intake, 1) for _, _, intake in found.values()] == [1.0, 0.8, 0.5]


@pytest.mark.slow
def test_crank_speed_alone(quick):
    lines = quick("speed_alone")
    assert lines["chapter 6 (a)", "misfire detection without pressure"].ours.startswith(
        "x_2 at its bound 0; "
    )
    assert lines["chapter 6 (a)", "no pressure in a car"].ours == "engine known: peaks within 1.3 %, 0.3 deg"


@pytest.mark.slow
def test_table_4_11(quick):
    lines = quick("friction_map")
    assert lines["Table 4.11", "C_eng over speed and load"].ours == "6 of 6 within 95 % intervals"


@pytest.mark.slow
def test_the_law_behind_table_4_11(quick):
    lines = quick("friction_law")
    words = "3 numbers: C_eng and coulomb_friction, load_friction"
    assert lines["Table 4.11", "36 coefficients"].ours == words


@pytest.mark.slow
def test_the_driveline(quick):
    lines = quick("driveline")
    found = lines["chapter 6 (c)", "the rest of the powertrain"].ours
    assert found == "10 inertias; modes 6.4, 29.7, 77.6 Hz below the crankshaft's"
    assert (
        lines["chapter 6 (c)", "order map of a run-up"].ours
        == "order 6.5 peaks at 338 Hz, the mode is at 335 Hz"
    )


@pytest.mark.slow
def test_the_misfire_detector(quick):
    lines = quick("misfire_detector")
    told = lines["Figures 5.2, 5.4", "they look alike"].ours
    assert told.startswith("two misfires: 1.000, all else: ")
    assert lines["chapter 5", "no detector"].ours.startswith("missed 0 of 12, false 0 of ")
    crank = lines["chapter 5", "a not complicated model"].ours
    assert crank == "crankshaft at 6000 RPM: 2 DOF miss 6 of 6, 7 DOF 0"


def test_the_gallery_lists_every_page_with_a_picture_that_is_there():
    folder = FOLDER.parent
    text = (folder / "README.md").read_text(encoding="utf-8")
    shown = re.findall(r'\| <img src="(\S+)" .* \| \[(\S+)\]\((\S+)\): (.*\.) \|', text)
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*.py") if path.stem != "shared"}
    assert {link for _, _, link, _ in shown} == files
    assert len(shown) == len(files)
    for picture, name, link, _ in shown:
        assert Path(link).name == name
        assert (folder / picture).is_file()
    assert len(list(folder.glob("*.*"))) <= 10
