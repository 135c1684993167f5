"""The bytes that the hardware would send: controllers behind pseudo-terminals, a GigE Vision camera, one bench."""
