"""The model of an instrument: trains, detector, noise, the states it takes, and what it can lack."""
