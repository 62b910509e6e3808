"""Effects: physical terms that a model may lack."""
