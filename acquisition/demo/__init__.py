"""`./lab demo`: undeclared faults, captures, diagnosis, correction, and the truth, on the simulated rig."""
