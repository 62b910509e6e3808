"""Discrepancy: where simulation and data disagree, and which effect, not in the model, explains it."""
