"""A repair that was read back: its page says the verdict without traces."""

import pytest

import casadi_engine as ce
from casadi_engine.report import to_result, write_result


def page(result, folder):
    document = to_result(result, command="repair", arguments={}, seconds=1.0, seed=0)
    again = ce.load_result(write_result(folder / "result.json", document))
    return ce.report(again, folder / "stored.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("kind", "words", "mood"),
    [
        ("repaired", ["and the data name it.", "dry friction at coupling: coupling.coulomb_friction.torque = 8.050 ± "
                      "0.070 N m; 99 % of the gap.", "Confirmed by fresh data.", "0.1458", "not testable",
                      "coupling.coulomb_friction.torque*tanh"], "good"),
        ("nothing_missing", ["Nothing is missing that these data could show."], "good"),
        ("unnamed", ["no effect of the library names", "looks cubic."], "poor"),
        ("no_answer", ["No answer: the fit without effects has not converged"], "poor"),
    ],
)  # fmt: skip
def test_the_page_of_a_stored_repair(kind, words, mood, request, tmp_path):
    html = page(request.getfixturevalue(kind), tmp_path)
    for part in words:
        assert part in html, part
    assert f'class="verdict {mood}"' in html
    assert "Traces are not stored in result.json" in html
