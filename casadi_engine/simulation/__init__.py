"""Simulation: exact discretisation and batched propagation with first- and second-order sensitivities."""
