"""Public measured data by name: where they come from, under which licence, and how they become captures."""
