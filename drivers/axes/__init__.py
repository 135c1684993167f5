"""Motion axes: one module for each kind of controller; the module's name is its kind in YAML."""
