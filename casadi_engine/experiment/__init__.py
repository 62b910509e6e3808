"""Experiments: measured channels, each with its own time, their readers and their conditioning."""
