"""A GigE Vision camera on loopback that shows pixels of the bench."""
