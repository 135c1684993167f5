"""What can be asked for, as values: a step knows its inputs and options, and makes or finds its product."""
