"""Problem: a model, its parameters, a reader, records and noise."""
