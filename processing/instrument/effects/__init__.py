"""Effects: one module for each thing that a model can lack; the module's name is its kind."""
