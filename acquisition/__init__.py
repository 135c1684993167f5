"""Plans, the rig, the runner and the capture writer: everything between a YAML file and a sealed capture."""
