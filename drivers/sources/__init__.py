"""Light sources: one module for each kind; the module's name is its kind in YAML."""
