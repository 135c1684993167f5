"""What a command loads when it runs and not for its help: these modules import what is heavy at their top."""
