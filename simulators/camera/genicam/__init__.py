"""A GigE Vision camera that plays the GenICam description of a maker as it is."""
