"""The printed table, letter by letter."""

from casadi_engine.parameters import Parameters

GOLDEN = """\
name      value  unit        min  max
J_eng      0.39  kg m2      0.05    4  prior 0.4 ± 0.05
J_load      0.5  kg m2      0.05    4  (fixed)
K_el    12345.7  N m/rad       0  inf
C_el          3  N m s/rad  -inf  inf  (fixed)
C2         0.04  N m s/rad     0  inf  == C_eng/4
C_eng      0.16  N m s/rad     0  inf  (one for each experiment) prior 0.2 ± 0.1
constraints
  0.35 <= J_eng + 4*J_load <= 3
  C2 <= 1
  ratio: J_eng/J_load == 0.78
  40 <= natural frequency 1 [Hz]"""


def filled(engine):
    engine["J_eng"].set(prior=(0.4, 0.05))
    engine.fix("J_load")
    engine["K_el"].set(12345.678)
    engine.tie("C2", "C_eng/4")
    engine.vary_by_experiment("C_eng")
    engine["C_eng"].set(prior=(0.2, 0.1))
    engine.constrain("J_eng + 4*J_load", 0.35, 3)
    engine.constrain("C2", max=1)
    engine.constrain(engine.symbol("J_eng") / engine.symbol("J_load"), 0.78, 0.78, name="ratio")
    engine.constrain_frequency(1, 40)
    return engine


def test_golden(engine):
    assert str(filled(engine)) == GOLDEN


def test_without_constraints_and_without_parameters(engine):
    assert "constraints" not in str(engine)
    assert str(Parameters()) == "name  value  unit  min  max"


def test_a_tie_without_a_value_is_shown(engine):
    engine.tie("C2", "log(C_eng - 1)")
    assert "C2        nan  N m s/rad" in str(engine)


def test_html_has_the_same_cells_and_escapes(engine):
    page = filled(engine)._repr_html_()
    assert page.count("<tr>") == 7
    assert '<td style="text-align:right">12345.7</td>' in page
    assert "0.35 &lt;= J_eng + 4*J_load &lt;= 3" in page
    engine.add("x", 1.0, unit="<script>")
    page = engine._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert Parameters()._repr_html_().endswith("</table>")
