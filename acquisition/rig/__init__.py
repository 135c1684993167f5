"""The rig: its file, the open hardware, where it must not go, and what has to hold while it measures."""
