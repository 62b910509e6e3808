"""Discrepancy: where a model and data disagree, and which effect is missing."""
