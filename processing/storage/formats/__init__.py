"""Files of other programs: tables of states, pictures, stacks, AxoStep, Mitsuba."""
