"""What emulated controllers share: port, motion in time, replies that faults can spoil."""
