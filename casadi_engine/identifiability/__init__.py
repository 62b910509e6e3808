"""Identifiability: what the data and the structure can tell about the parameters."""
