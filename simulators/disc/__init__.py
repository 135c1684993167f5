"""A disc that is watched: every call that changes it is counted, written down, and may be the last one."""
