"""Estimation: the multiple-shooting problem, its solution, and the uncertainty of the answer."""
