"""Validation: how well a model explains data, and whether its residuals are white."""
