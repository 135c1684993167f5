"""Emulated controllers: one module for each kind, speaking the bytes of the real one."""
