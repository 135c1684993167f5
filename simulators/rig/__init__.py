"""The simulated rig: emulators for all that a rig file names, with the bench behind them."""
